"""A folder for the Hugging Face Hub: Parquet per split, a data set card and a Croissant description."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

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
_SIZES = (
    (10**3, "n<1K"),
    (10**4, "1K<n<10K"),
    (10**5, "10K<n<100K"),
    (10**6, "100K<n<1M"),
    (10**7, "1M<n<10M"),
)
# The Hub's licences that datagen's sources have; it has no others' names.
_LICENCES = ("apache-2.0", "cc-by-4.0", "cc-by-nc-4.0", "cc-by-sa-4.0", "cc0-1.0", "mit", "bsd-3-clause")


def steps(source: ExportSource) -> Sequence[Step]:
    """Tables `candidates` and `scenes` by split of their houses, then card and description."""
    made: list[Step] = []
    for table, (_, shards_of, _) in _TABLES.items():
        for number, shards in enumerate(shards_of(source)):
            made.append(partial(_table, source, table, number, shards))
    return [*made, partial(_documents, source)]


def _table(
    source: ExportSource, table: str, number: int, shards: Sequence[Shard], _: Made
) -> Iterator[NewFile]:
    fields_of, _, batch_of = _TABLES[table]
    fields = fields_of(source)
    for ours, theirs in _SPLITS.items():
        batches = (_of_split(batch_of(shard, fields), ours) for shard in shards)
        data, counts = parquet_of(fields, batches, source)
        if counts["rows"]:
            yield NewFile(f"{table}/{theirs}-{number:05d}.parquet", data, counts)


def _of_split(batch: pa.RecordBatch, split: str) -> pa.RecordBatch:
    return batch.filter(pc.equal(batch.column("split"), split))


def _documents(source: ExportSource, made: Made) -> Iterator[NewFile]:
    manifests = [run.manifest for run in source.runs]
    found = (asset for m in manifests for asset in assets_of(m.spec, m.sources))
    assets = list(dict.fromkeys(found))
    fields = {table: fields_of(source) for table, (fields_of, _, _) in _TABLES.items()}
    yield NewFile("README.md", _card(source, assets, fields, made.files).encode())
    single = {
        table: [(field, dtype_of(field)) for field in columns if not field.dims]
        for table, columns in fields.items()
    }
    licences = dict.fromkeys(asset.licence for asset in assets)
    yield NewFile(
        "croissant.json",
        croissant(source.about, list(licences), manifests[0].created, single, made.files),
    )


def _card(
    source: ExportSource,
    assets: Sequence[Asset],
    fields: dict[str, Sequence[Field]],
    files: Sequence[ExportedFile],
) -> str:
    about = source.about
    rows = sum(file.counts["rows"] for file in files if file.path.startswith("candidates/"))
    head = [
        "---",
        f"license: {json.dumps(_hub_licences(assets))}",
        f"pretty_name: {json.dumps(about['title'])}",
        f"size_categories: [{next((name for most, name in _SIZES if rows < most), 'n>10M')}]",
        "task_categories: [robotics]",
        "tags: [robotics, mobile-manipulation, base-placement, point-cloud, datagen]",
        "configs:",
    ]
    for table in fields:
        head += [f"- config_name: {table}", *["  default: true"] * (table == "candidates"), "  data_files:"]
        for split, _ in _splits(table, files):
            head += [f"  - split: {split}", f"    path: {table}/{split}-*.parquet"]
    head.append("dataset_info:")
    for table, columns in fields.items():
        head += [f"- config_name: {table}", "  features:"]
        for field in columns:
            head += [f"  - name: {field.name}", *_feature(field)]
        head.append("  splits:")
        parts = _splits(table, files)
        for split, mine in parts:
            total = {key: sum(file.counts[key] for file in mine) for key in ("bytes", "rows")}
            head += [f"  - name: {split}", f"    num_bytes: {total['bytes']}"]
            head += [f"    num_examples: {total['rows']}"]
        every = [file for _, mine in parts for file in mine]
        head += [f"  download_size: {sum(file.size for file in every)}"]
        head += [f"  dataset_size: {sum(file.counts['bytes'] for file in every)}"]
    body = [
        "---",
        "",
        f"# {about['title']}",
        "",
        about["summary"],
        "",
        "The table `candidates` has one row per candidate base pose, joined with its scene; `scenes` has one "
        "row per scene, with its point cloud. `scene_id` joins them. Each house is in one split.",
        "",
        "## Licences",
        "",
        *(f"- {asset.name}: {asset.licence} ({asset.reference})" for asset in assets),
        "",
        "## How it was made",
        "",
        *(f"- `{line}`" for line in about["history"].split("\n")),
    ]
    for table, columns in fields.items():
        body += [
            "",
            f"## Columns of {table}",
            "",
            "| column | unit | frame | content |",
            "| --- | --- | --- | --- |",
        ]
        body += [f"| `{f.name}` | {f.unit} | {f.frame} | {f.doc.replace('|', '/')} |" for f in columns]
    return "\n".join([*head, *body]) + "\n"


def _splits(table: str, files: Sequence[ExportedFile]) -> list[tuple[str, list[ExportedFile]]]:
    """Splits of a table that have rows, with their files."""
    found = {s: [f for f in files if f.path.startswith(f"{table}/{s}-")] for s in _SPLITS.values()}
    return [(split, mine) for split, mine in found.items() if mine]


def _feature(field: Field) -> list[str]:
    """A column's type in the card, after its name."""
    lines, indent = list[str](), "    "
    for _ in field.dims[:-1]:
        lines.append(f"{indent}list:")
        indent += "  "
    return [*lines, f"{indent}{'list' if field.dims else 'dtype'}: {dtype_of(field)}"]


def _hub_licences(assets: Iterable[Asset]) -> list[str]:
    """The Hub's names of the licences: "unknown" where none is stated, "other" for those without a name."""
    names: dict[str, Any] = {}
    for asset in assets:
        name = asset.licence.lower()
        names["unknown" if name == "not stated" else name if name in _LICENCES else "other"] = None
    return list(names)
