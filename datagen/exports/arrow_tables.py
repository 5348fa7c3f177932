"""Candidates and scenes as Arrow tables, and as Parquet with descriptions and units of columns.

Arrow's types are unknown to type checkers: batches and schemas are Any here.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from datagen.exports.export_run import ExportSource, Shard, scene_key
from datagen.schemas.fields import SCHEMAS, Field
from datagen.tables.candidate_rows import DEFAULT, Array, candidate_columns, needed_arrays
from datagen.train.reader import JOIN_FIELDS, native
from datagen.workers.houses import split_of

# Columns of a cloud's points; rows without a point are left out.
CLOUD = ("points_m", "rgb", "target_mask")
_SPLIT = Field("split", "string", (), "", "", "side of the split of houses: train, val or test")
_SCENE_ID = Field("scene_id", "string", (), "", "", "12 digits of the specification's hash, and scene_index")
# From either on, rows are written together.
_GROUP_ROWS, _GROUP_BYTES = 2**16, 2**25
# Columns of candidates that are made from several arrays, or from a part of one.
_MADE = {
    field.name: field
    for field in (
        _SCENE_ID,
        _SPLIT,
        Field("sample_id", "string", (), "", "", "hash of specification, scene and candidate, 32 digits"),
        Field("house", "string", (), "", "", "house, as its source names it"),
        Field("object", "string", (), "", "", "target object"),
        Field("robot", "string", (), "", "", "robot; missing where labels have no particular arm"),
        Field("base_x_world_m", "float32", (), "m", "world", "base position, x"),
        Field("base_y_world_m", "float32", (), "m", "world", "base position, y"),
        Field("base_yaw_world_rad", "float32", (), "rad", "world", "heading, counter-clockwise from x"),
        Field("base_x_target_m", "float64", (), "m", "target", "base position from the target's centre, x"),
        Field("base_y_target_m", "float64", (), "m", "target", "base position from the target's centre, y"),
        Field("target_x_world_m", "float64", (), "m", "world", "centre of the target's bounding box, x"),
        Field("target_y_world_m", "float64", (), "m", "world", "centre of the target's bounding box, y"),
        Field("target_z_world_m", "float64", (), "m", "world", "centre of the target's bounding box, z"),
    )
}
# Of paths and machines, or the same as others.
_LEFT_OUT = ("run", "cost_s", "house_id", "sample_scene_index", "base_yaw_rad")


def candidate_fields(source: ExportSource) -> list[Field]:
    """The columns of the candidates' table: those of `datagen.candidates`, then the other single values."""
    stored = {field.name: field for _, field in SCHEMAS[source.runs[0].schema.name].fields}
    single = [name for name, field in stored.items() if not field.dims]
    names = ["scene_id", "sample_id", *(n for n in DEFAULT if n in _MADE or n in stored), *single]
    return [_MADE.get(name) or stored[name] for name in dict.fromkeys(names) if name not in _LEFT_OUT]


def candidate_shards(source: ExportSource) -> list[list[Shard]]:
    """The source's shards with the arrays of the candidates' table, grouped for one file each."""
    return source.shards(needed_arrays([f.name for f in candidate_fields(source) if f is not _SCENE_ID]))


def candidate_batch(shard: Shard, fields: Sequence[Field]) -> Any:
    """One row for each candidate of a shard."""
    names = [field.name for field in fields if field is not _SCENE_ID]
    columns = candidate_columns(*shard, names)
    columns["scene_id"] = _scene_ids(shard, columns["scene_index"])
    return _batch(fields, columns)


def scene_fields(source: ExportSource) -> list[Field]:
    """The columns of the scenes' table: all that is stored of a scene."""
    return [_SCENE_ID, _SPLIT, *SCHEMAS[source.runs[0].schema.name].scene_fields]


def scene_shards(source: ExportSource) -> list[list[Shard]]:
    """The source's shards with the arrays of scenes, grouped for one file each."""
    return source.shards([*JOIN_FIELDS, *(field.name for field in scene_fields(source)[2:])])


def scene_batch(shard: Shard, fields: Sequence[Field]) -> Any:
    """One row for each scene of a shard; clouds have their points alone."""
    part, place = shard
    columns: dict[str, Any] = dict(place.read(part.arrays[field.name] for field in fields[2:]))
    columns = {name: native(values) for name, values in columns.items()}
    columns["scene_id"] = _scene_ids(shard, columns["scene_index"])
    columns["split"] = np.array([split_of(str(house)) for house in columns["house_id"]], object)
    for name in CLOUD:
        columns[name] = [cloud[:n] for cloud, n in zip(columns[name], columns["n_points"], strict=True)]
    return _batch(fields, columns)


def parquet_of(
    fields: Sequence[Field], batches: Iterable[Any], source: ExportSource
) -> tuple[bytes, dict[str, int]]:
    """The bytes of a Parquet file, and its numbers of rows and of bytes in memory.

    The file's metadata has title and licences; that of each column description, unit and frame.
    """
    about = {key: source.about[key] for key in ("title", "license", "acknowledgement", "history")}
    schema = arrow_schema(fields).with_metadata({"datagen": json.dumps(about)})
    sink, rows, size = pa.BufferOutputStream(), 0, 0
    with pq.ParquetWriter(sink, schema, compression="zstd") as writer:
        for group in _row_groups(batches):
            writer.write_table(pa.Table.from_batches(group), row_group_size=sum(b.num_rows for b in group))
            rows, size = rows + sum(b.num_rows for b in group), size + sum(b.nbytes for b in group)
    return sink.getvalue().to_pybytes(), {"rows": rows, "bytes": size}


def _row_groups(batches: Iterable[Any]) -> Iterator[list[Any]]:
    """The batches with rows, several together where they are small."""
    group: list[Any] = []
    for batch in batches:
        group += [batch] if batch.num_rows else []
        if sum(b.num_rows for b in group) >= _GROUP_ROWS or sum(b.nbytes for b in group) >= _GROUP_BYTES:
            yield group
            group = []
    if group:
        yield group


def arrow_schema(fields: Sequence[Field]) -> Any:
    """The columns with their types and, as metadata, description, unit and frame."""
    return pa.schema(
        [
            pa.field(
                field.name,
                _arrow_type(field),
                metadata={"description": field.doc, "unit": field.unit, "frame": field.frame},
            )
            for field in fields
        ]
    )


def dtype_of(field: Field) -> str:
    """The type of a column's numbers: texts for codes, single precision for half."""
    return "string" if field.codes else {"float16": "float32"}.get(field.dtype, field.dtype)


def _leaf_type(field: Field) -> Any:
    name = dtype_of(field)
    return pa.string() if name == "string" else pa.from_numpy_dtype(np.dtype(name))


def _arrow_type(field: Field) -> Any:
    found = _leaf_type(field)
    for _ in field.dims:
        found = pa.list_(found)
    return found


def _scene_ids(shard: Shard, scene_index: Array) -> Array:
    part = shard[0]
    (spec_hash,) = part.spec_hashes  # a run has one
    return np.array([scene_key(spec_hash, index) for index in scene_index.tolist()], object)


def _batch(fields: Sequence[Field], columns: dict[str, Any]) -> Any:
    arrays = [_arrow_array(field, columns[field.name]) for field in fields]
    return pa.RecordBatch.from_arrays(arrays, schema=arrow_schema(fields))


def _arrow_array(field: Field, values: Any) -> Any:
    if isinstance(values, list):  # arrays of different lengths
        ends = np.cumsum([0, *map(len, values)], dtype=np.int32)
        return pa.ListArray.from_arrays(ends, _nested(field, np.concatenate(values)))
    return _nested(field, np.array(field.codes, object)[values] if field.codes else values)


def _nested(field: Field, values: Array) -> Any:
    """Rows of any shape as (lists of) values."""
    found = pa.array(values.reshape(-1), _leaf_type(field))
    for size in reversed(values.shape[1:]):
        found = pa.ListArray.from_arrays(np.arange(0, len(found) + 1, size, dtype=np.int32), found)
    return found
