"""Candidates joined with their scenes as Parquet, one row a candidate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from datagen.exports.arrow_tables import candidate_batch, candidate_fields, candidate_shards, parquet_of
from datagen.exports.export_run import ExportSource, Made, NewFile, Shard, Step


def steps(source: ExportSource) -> Sequence[Step]:
    """`candidates/00000.parquet` and so on, one for some shards."""
    groups = candidate_shards(source)
    return [partial(_table, source, number, shards) for number, shards in enumerate(groups)]


def _table(source: ExportSource, number: int, shards: Sequence[Shard], _: Made) -> Iterator[NewFile]:
    fields = candidate_fields(source)
    data, counts = parquet_of(fields, (candidate_batch(shard, fields) for shard in shards), source)
    yield NewFile(f"candidates/{number:05d}.parquet", data, counts)
