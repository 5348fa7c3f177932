"""Encode a shard as one object: a flat Zarr v3 group in an uncompressed zip, which Zarr's ZipStore opens.

All arrays of both tables are at the group's root; their first dimension is "scene" or "sample". Chunks are
bytes (or vlen-utf8) -> zstd -> crc32c, every chunk is written, and its key has no folders ("c.0.0").
zarr-python makes the metadata once per layout, which takes 3 ms per array; chunks are encoded directly. Tests
compare the bytes with those that zarr-python writes.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import google_crc32c
import numpy as np
import numpy.typing as npt
import zarr
from numcodecs.vlen import VLenUTF8
from numcodecs.zstd import Zstd
from zarr.codecs import BytesCodec, Crc32cCodec, VLenUTF8Codec, ZstdCodec
from zarr.storage import MemoryStore

from datagen.schemas.errors import InputError
from datagen.schemas.fields import REDRAW_CAUSES, TABLES, Field, RecordSchema, Table
from datagen.schemas.run_records import Layout
from datagen.schemas.specification import Specification

Array = npt.NDArray[Any]

ZSTD_LEVEL = 3
# Uncompressed, of a sealed store's files: of clouds, whose rows are large, and of other arrays.
_CLOUD_FILE_BYTES, _FILE_BYTES, _LARGE_ROW_BYTES = 64 * 2**20, 8 * 2**20, 2**10
MAX_CHUNK_BYTES = 4 * 2**20  # of uncompressed numbers; keeps random reads of single clouds cheap
MAX_TEXT_BYTES = 4096  # the longest name


def rows_per_shard(layout: Layout, table: Table) -> int:
    """Rows of a table in every shard."""
    return layout.scenes_per_shard if table == "scene" else layout.samples_per_shard


def chunk_rows(schema: RecordSchema, field: Field, rows: int) -> int:
    """Rows per chunk: the largest divisor of a shard's rows within the chunk size.

    A divisor, because the sealed store is a regular grid of chunks.
    """
    if field.is_text:
        return rows
    most = max(1, MAX_CHUNK_BYTES // _row_bytes(schema, field))
    return next(c for c in range(min(rows, most), 0, -1) if rows % c == 0)


def _chunks_per_file(schema: RecordSchema, field: Field, step: int, rows: int) -> int:
    """Chunks of `step` rows in each file of a sealed array."""
    row_bytes = _row_bytes(schema, field)
    most = _CLOUD_FILE_BYTES if row_bytes >= _LARGE_ROW_BYTES else _FILE_BYTES
    return max(1, min(most // (row_bytes * step), -(-rows // step)))


def _row_bytes(schema: RecordSchema, field: Field) -> int:
    """Bytes of a row; of text an estimate."""
    if field.is_text:
        return 64
    return int(np.prod(schema.shape(field, 1))) * np.dtype(field.dtype).itemsize


def chunk_path(name: str, index: int, axes: int) -> str:
    """Path of a chunk, or of a file of chunks, of an array with further `axes` than its rows."""
    return f"{name}/c.{index}{'.0' * axes}"


def chunk_paths(schema: RecordSchema, layout: Layout, table: Table, field: Field) -> tuple[str, ...]:
    """Paths of an array's chunks in a shard's folder, in order of rows."""
    rows = rows_per_shard(layout, table)
    count = rows // chunk_rows(schema, field, rows)
    return tuple(chunk_path(field.name, i, len(field.dims)) for i in range(count))


def fill_value(field: Field) -> Any:
    """Fill value of missing chunks: never a plausible value."""
    if field.is_text:
        return ""
    dtype = np.dtype(field.dtype)
    if dtype.kind == "f":
        return float("nan")
    if dtype.kind == "b":
        return False
    return -1 if dtype.kind == "i" else int(np.iinfo(dtype).max)


def encode_shard(
    schema: RecordSchema,
    layout: Layout,
    spec_hash: str,
    scene_arrays: Mapping[str, Array],
    sample_arrays: Mapping[str, Array],
) -> bytes:
    """Return the object of one full shard.

    `scene_arrays` have `layout.scenes_per_shard` rows, `sample_arrays` `samples_per_shard`, sorted
    by scene. InputError when an array breaks the schema.
    """
    files = dict(group_metadata(schema, layout, spec_hash))
    for table, arrays in zip(TABLES, (scene_arrays, sample_arrays), strict=True):
        schema.check(table, rows_per_shard(layout, table), arrays)
        for field in schema.table(table):
            files |= encode_array(schema, layout, table, field, arrays[field.name])
    return zipped(files)


def zipped(files: Mapping[str, bytes]) -> bytes:
    """The files in an uncompressed zip; equal files give equal bytes."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_STORED) as archive:
        for path, data in files.items():
            archive.writestr(_entry(path), data)
    return made.getvalue()


def _entry(path: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0))
    entry.create_system = 3  # else that of the machine
    return entry


def encode_array(
    schema: RecordSchema,
    layout: Layout,
    table: Table,
    field: Field,
    values: Array,
    level: int | None = None,
) -> dict[str, bytes]:
    """Return the chunks of one array of a full shard, by path."""
    paths = chunk_paths(schema, layout, table, field)
    step = len(values) // len(paths)
    parts = (values[first : first + step] for first in range(0, len(values), step))
    return {path: encode_chunk(field, part, level) for path, part in zip(paths, parts, strict=True)}


def encode_chunk(field: Field, values: Array, level: int | None = None) -> bytes:
    """Encode a chunk as Zarr's codecs do; readers need not know the level of zstd [`ZSTD_LEVEL`]."""
    if field.is_text:
        raw = VLenUTF8().encode(_checked_text(field, values))
    else:
        raw = np.ascontiguousarray(values, np.dtype(field.dtype).newbyteorder("<"))
    return with_crc32c(bytes(Zstd(level=ZSTD_LEVEL if level is None else level).encode(raw)))


def with_crc32c(data: bytes) -> bytes:
    """The data and its checksum, as Zarr's codec writes it."""
    return data + google_crc32c.value(data).to_bytes(4, "little")


@lru_cache(maxsize=16)
def group_metadata(schema: RecordSchema, layout: Layout, spec_hash: str) -> Mapping[str, bytes]:
    """Every zarr.json of a shard by path: the root's, with the schema's name, and each array's."""
    rows: dict[str, int] = {table: rows_per_shard(layout, table) for table in TABLES}
    return zarr_metadata(schema, layout, rows, root_attributes(schema, layout, spec_hash))


def root_attributes(schema: RecordSchema, layout: Layout, spec_hash: str) -> dict[str, Any]:
    """Common attributes of a shard's group and of the sealed store."""
    return {
        "schema": schema.name,
        "schema_version": schema.version,
        "spec_hash": spec_hash,
        "scenes_per_shard": layout.scenes_per_shard,
        "candidates_per_scene": layout.candidates_per_scene,
        "redraw_causes": list(REDRAW_CAUSES),
    }


def zarr_metadata(
    schema: RecordSchema,
    layout: Layout,
    rows: Mapping[str, int],
    attributes: Mapping[str, Any],
    of_arrays: Mapping[str, Mapping[str, Any]] | None = None,
    is_sharded: bool = False,
) -> dict[str, bytes]:
    """Return the zarr.json files of a group with `rows` per table, chunked like the layout's shards.

    `of_arrays` are further attributes of arrays, by name. With `is_sharded`, many chunks share a file.
    """
    files: dict[str, bytes] = {}
    for path, data in _made_by_zarr(schema, layout, tuple(rows.items()) if is_sharded else ()).items():
        meta = json.loads(data)
        if path == "zarr.json":
            meta["attributes"] = dict(attributes)
        else:
            meta["shape"][0] = rows[meta["dimension_names"][0]]
            meta["attributes"] |= (of_arrays or {}).get(path.partition("/")[0], {})
        files[path] = json.dumps(meta, indent=2).encode()
    return files


@lru_cache(maxsize=16)
def _made_by_zarr(
    schema: RecordSchema, layout: Layout, sharded: tuple[tuple[str, int], ...] = ()
) -> Mapping[str, bytes]:
    """Metadata by zarr-python for a group with one shard's rows, or with these rows per table in files of
    many chunks."""
    store: dict[str, Any] = {}
    group = zarr.create_group(MemoryStore(store), zarr_format=3, attributes={"": ""})
    for table, field in schema.fields:
        rows = rows_per_shard(layout, table)
        step = chunk_rows(schema, field, rows)
        many = _chunks_per_file(schema, field, step, dict(sharded)[table]) if sharded else 0
        codec = VLenUTF8Codec() if field.is_text else BytesCodec(endian="little")
        group.create_array(
            field.name,
            shape=schema.shape(field, rows),
            chunks=schema.shape(field, step),
            shards=schema.shape(field, many * step) if many else None,
            dtype=field.dtype,
            fill_value=fill_value(field),
            serializer=codec,
            compressors=[ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec()],
            filters=None,
            chunk_key_encoding={"name": "default", "separator": "."},
            dimension_names=(table, *field.dims),
            attributes=field_attributes(field),
            config={"write_empty_chunks": True},
        )
    return {path: buffer.to_bytes() for path, buffer in store.items()}


def field_attributes(field: Field) -> dict[str, Any]:
    """An array's attributes, with CF names where they exist."""
    attributes = {
        "long_name": field.doc,
        "units": field.unit,
        "frame": field.frame,
        "valid_min": field.low,
        "valid_max": field.high,
        "flag_meanings": " ".join(field.codes),
    }
    return {name: value for name, value in attributes.items() if value not in (None, "")}


def _checked_text(field: Field, values: Array) -> Array:
    texts = np.asarray(values, dtype=object)
    for text in texts.flat:
        try:
            ok = isinstance(text, str) and len(text.encode()) <= MAX_TEXT_BYTES
        except UnicodeEncodeError:
            ok = False
        if not ok:
            raise InputError(
                "batch",
                field.name,
                f"{text!r:.60} is not valid text of at most {MAX_TEXT_BYTES} bytes",
                "Give the house or object a short name in valid Unicode",
            )
    return texts


CONVENTIONS = "CF-1.11, ACDD-1.3"


class Asset(NamedTuple):
    """Content that labels were made from, with its licence and how to cite it."""

    name: str
    licence: str
    reference: str


# Of what a folder holds only its own statement says the origin.
_NOT_STATED = "not stated"
_OURS = "datagen, which comes with it"
_BUILTIN = {
    "houses": Asset("built-in houses", "Apache-2.0", _OURS),
    "objects": Asset("built-in objects", "Apache-2.0", _OURS),
}
# As the package states for its assets, which include the robots.
_ROBOTS = Asset(
    "ManiSkill robot models",
    "CC-BY-NC-4.0",
    "Tao et al., ManiSkill3: GPU Parallelized Robotics Simulation and Rendering for Generalizable Embodied "
    "AI, 2024, arXiv:2410.00425",
)
_COMMENT = (
    "Arrays of dimension scene and arrays of dimension sample (a candidate base pose) are two tables, joined "
    "by scene_index and sample_scene_index. A data frame over both dimensions would hold their product: "
    "use datagen.candidates(path), which joins them."
)


def described(
    specs: Sequence[Specification], sources: Sequence[Mapping[str, str]], samples: Sequence[int] = ()
) -> dict[str, Any]:
    """The global attributes of a store over runs of these specifications, with `samples` each.

    `sources` are those of the runs' manifests, which hold the statements of folders.
    """
    each = [assets_of(spec, known) for spec, known in zip(specs, sources, strict=True)]
    assets = list(dict.fromkeys(asset for found in each for asset in found))
    labels = _listed(spec.label_source for spec in specs)
    houses, objects = (_listed(found[k].name for found in each) for k in (0, 1))
    return {
        "Conventions": CONVENTIONS,
        "title": f"Robot base poses labelled by {labels}, in {houses} with {objects}",
        "summary": (
            "Candidate base poses of a mobile manipulator around a target object on a support surface, each "
            "with a label that says whether the robot can work from there, and the RGB-D point cloud of "
            "each scene."
        ),
        "source": "; ".join(dict.fromkeys(map(_source, specs))),
        "license": "; ".join(f"{asset.name}: {asset.licence}" for asset in assets),
        "acknowledgement": "; ".join(f"{asset.name}: {asset.reference}" for asset in assets),
        "references": "; ".join(dict.fromkeys(a.reference for a in assets if a.reference != _NOT_STATED)),
        "history": "\n".join(
            f"datagen submit {spec.label_source}{n}, seed {spec.seed}, split {spec.split}, "
            f"specification {spec.hash()}"
            for spec, n in zip(specs, [f" --n {n}" for n in samples] or [""] * len(specs), strict=True)
        ),
        "comment": _COMMENT,
    }


def cf_attributes(field: Field, table: Table) -> dict[str, Any]:
    """CF attributes of an array in a sealed store; arrays of shards do not have them."""
    keys = ("scene_index", "house_id")
    if table == "sample":
        keys = ("sample_scene_index", "candidate_index", "robot_index")
    coordinates = {} if field.name in keys else {"coordinates": " ".join(keys)}
    return coordinates | ({"flag_values": list(range(len(field.codes)))} if field.codes else {})


def assets_of(spec: Specification, known: Mapping[str, str]) -> list[Asset]:
    """Houses, objects and, for an arm, robots; other packages' robots and files state no licence."""
    found: list[Asset] = []
    for what, source in (("houses", spec.houses), ("objects", spec.objects)):
        title = known.get(f"{what}_title", f"{what} read as {source.kind}")
        told = (known.get(f"{what}_{key}", _NOT_STATED) for key in ("licence", "attribution"))
        found.append(_BUILTIN[what] if source.kind == "builtin" else Asset(title, *told))
    if spec.arm is None:
        return found
    own = Asset(f"robot {spec.arm.robot}", _NOT_STATED, _NOT_STATED)
    return [*found, _ROBOTS if spec.arm.robot_digest is None else own]


def _source(spec: Specification) -> str:
    parts = [f"houses {spec.houses.kind} sha256 {spec.houses.digest}"]
    parts.append(f"objects {spec.objects.kind} sha256 {spec.objects.digest}")
    if spec.arm is not None:
        parts.append(f"robot {spec.arm.robot}")
    return ", ".join(parts + [f"{name} {version}" for name, version in sorted(spec.engines.items())])


def _listed(names: Any) -> str:
    return " and ".join(dict.fromkeys(names))
