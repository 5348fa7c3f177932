"""A folder for the Hugging Face Hub: Parquet per split, a data set card and a Croissant description."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from datagen.exports.arrow_tables import (
    candidate_batch,
    candidate_fields,
    candidate_shards,
    dtype_of,
    parquet_of,
    scene_batch,
    scene_fields,
    scene_shards,
)
from datagen.exports.croissant import croissant
from datagen.exports.export_record import ExportedFile
from datagen.exports.export_run import ExportSource, Made, NewFile, Shard, Step
from datagen.schemas.fields import Field
from datagen.schemas.shard_files import Asset, assets_of

# Our names of the splits, and the Hub's.
_SPLITS = {"train": "train", "val": "validation", "test": "test"}
_TABLES = {
    "candidates": (candidate_fields, candidate_shards, candidate_batch),
    "scenes": (scene_fields, scene_shards, scene_batch),
}
_SIZES = {10**3: "n<1K", 10**4: "1K<n<10K", 10**5: "10K<n<100K", 10**6: "100K<n<1M", 10**7: "1M<n<10M"}
# Licences that the Hub has a name for: their own in lower case.
_LICENCES = ("apache-2.0", "cc-by-4.0", "cc-by-nc-4.0", "cc-by-sa-4.0", "cc0-1.0", "mit", "bsd-3-clause")


def steps(source: ExportSource) -> Sequence[Step]:
    """Tables `candidates` and `scenes` by split of their houses, then card and description."""
    made: list[Step] = [
        partial(_table, source, table, number, shards)
        for table, (_, shards_of, _) in _TABLES.items()
        for number, shards in enumerate(shards_of(source))
    ]
    return [*made, partial(_documents, source)]


def _table(
    source: ExportSource, table: str, number: int, shards: Sequence[Shard], _: Made
) -> Iterator[NewFile]:
    fields_of, _shards, batch_of = _TABLES[table]
    fields = fields_of(source)
    batches = [batch_of(shard, fields) for shard in shards]  # read once for all splits
    splits = [np.array(batch.column("split").to_pylist()) for batch in batches]
    for ours, theirs in _SPLITS.items():
        rows = (b.take(np.flatnonzero(s == ours)) for b, s in zip(batches, splits, strict=True))
        data, counts = parquet_of(fields, rows, source)
        if counts["rows"]:
            yield NewFile(f"{table}/{theirs}-{number:05d}.parquet", data, counts)


def _documents(source: ExportSource, made: Made) -> Iterator[NewFile]:
    manifests = [run.manifest for run in source.runs]
    assets = list(dict.fromkeys(asset for m in manifests for asset in assets_of(m.spec, m.sources)))
    fields = {table: fields_of(source) for table, (fields_of, _, _) in _TABLES.items()}
    text = "\n".join([*_head(source, assets, fields, made.files), *_body(source, assets, fields)])
    yield NewFile("README.md", f"{text}\n".encode())
    single = {name: [(f, dtype_of(f)) for f in columns if not f.dims] for name, columns in fields.items()}
    licences = list(dict.fromkeys(asset.licence for asset in assets))
    data = croissant(source.about, licences, manifests[0].created, single, made.files)
    yield NewFile("croissant.json", data)


def _head(
    source: ExportSource,
    assets: Sequence[Asset],
    fields: Mapping[str, Sequence[Field]],
    files: Sequence[ExportedFile],
) -> Iterator[str]:
    """The card's lines of YAML."""
    rows = sum(file.counts["rows"] for file in files if file.path.startswith("candidates/"))
    yield from ("---", f"license: {json.dumps(_hub_licences(assets))}")
    yield f"pretty_name: {json.dumps(source.about['title'])}"
    yield f"size_categories: [{next((name for most, name in _SIZES.items() if rows < most), 'n>10M')}]"
    yield "task_categories: [robotics]"
    yield "tags: [robotics, mobile-manipulation, base-placement, point-cloud, datagen]"
    yield "configs:"
    for table in fields:
        default = f"  default: {'true' if table == 'candidates' else 'false'}"
        yield from (f"- config_name: {table}", default, "  data_files:")
        for split, _ in _splits(table, files):
            yield from (f"  - split: {split}", f"    path: {table}/{split}-*.parquet")
    yield "dataset_info:"
    for table, columns in fields.items():
        yield from (f"- config_name: {table}", "  features:")
        for field in columns:
            nested = [f"    {'  ' * depth}list:" for depth in range(len(field.dims) - 1)]
            last = f"{'list' if field.dims else 'dtype'}: {dtype_of(field)}"
            yield from (f"  - name: {field.name}", *nested, f"    {'  ' * len(nested)}{last}")
        yield "  splits:"
        parts = _splits(table, files)
        for split, mine in parts:
            yield from (f"  - name: {split}", f"    num_bytes: {sum(file.counts['bytes'] for file in mine)}")
            yield f"    num_examples: {sum(file.counts['rows'] for file in mine)}"
        every = [file for _, mine in parts for file in mine]
        yield f"  download_size: {sum(file.size for file in every)}"
        yield f"  dataset_size: {sum(file.counts['bytes'] for file in every)}"
    yield "---"


def _body(
    source: ExportSource, assets: Sequence[Asset], fields: Mapping[str, Sequence[Field]]
) -> Iterator[str]:
    about = source.about
    yield from ("", f"# {about['title']}", "", about["summary"], "")
    yield (
        "The table `candidates` has one row per candidate base pose, joined with its scene; `scenes` has one "
        "row per scene, with its point cloud. `scene_id` joins them. Each house is in one split."
    )
    yield from ("", "## Licences", "")
    yield from (f"- {asset.name}: {asset.licence} ({asset.reference})" for asset in assets)
    yield from ("", "## How it was made", "", *(f"- `{line}`" for line in about["history"].split("\n")))
    for table, columns in fields.items():
        yield from ("", f"## Columns of {table}", "", "| column | unit | frame | content |")
        yield "| --- | --- | --- | --- |"
        yield from (f"| `{f.name}` | {f.unit} | {f.frame} | {f.doc.replace('|', '/')} |" for f in columns)


def _splits(table: str, files: Sequence[ExportedFile]) -> list[tuple[str, list[ExportedFile]]]:
    found = {s: [f for f in files if f.path.startswith(f"{table}/{s}-")] for s in _SPLITS.values()}
    return [(split, mine) for split, mine in found.items() if mine]


def _hub_licences(assets: Sequence[Asset]) -> list[str]:
    """The Hub's names of the licences: "unknown" where none is stated, "other" for those without a name."""
    names = [asset.licence.lower() for asset in assets]
    known = [n if n in _LICENCES else "unknown" if n == "not stated" else "other" for n in names]
    return list(dict.fromkeys(known))
