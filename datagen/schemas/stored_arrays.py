"""Arrays as they are stored: their metadata, the paths of their chunks, and the values in these.

Metadata and chunks are not trusted: sizes are checked before memory is allocated for them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import google_crc32c
import numpy as np
import numpy.typing as npt
from numcodecs.vlen import VLenUTF8
from numcodecs.zstd import Zstd

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SAMPLE_FIELDS, SCENE_FIELDS, RecordSchema
from datagen.schemas.run_records import Layout
from datagen.schemas.shard_files import MAX_TEXT_BYTES, chunk_path, field_attributes, group_metadata

Array = npt.NDArray[Any]

MAX_META_BYTES = 2**20
MAX_DECODED_BYTES = 2**30  # far above any real chunk
_MAX_PER_FILE = 2**20
_NUMBERS = {"bool", "float16", "float32", "float64"}
_NUMBERS |= {f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)}
# Arrays that stores of older versions lack, and those of which readers compute them (`ShardPlace.read`):
# headings face the target, and numbers of scenes are 0, as on an open top (place) and not chosen by labels.
COMPUTED = {
    "base_yaw_rad": ("base_xy_m", "target_center_m"),
    "place": ("scene_index",),
    "good_share": ("scene_index",),
    "decisive_draws": ("scene_index",),
}
_FIELDS = {field.name: field for field in (*SCENE_FIELDS, *SAMPLE_FIELDS) if field.name in COMPUTED}
DAMAGE_FIX = "Restore the file from a copy, or set the shard aside with `datagen verify --repair`"


@dataclass(frozen=True)
class StoredArray:
    """Metadata of an array; rows and chunk rows are along the first axis, `dims[0]`.

    `per_file` chunks lie in one file of a sealed store, with an index (Zarr's sharding codec); 0 where each
    is a file.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    chunk_rows: int
    per_file: int
    dims: tuple[str, ...]
    attributes: Mapping[str, Any]
    computed_from: tuple[StoredArray, ...] = ()  # empty where it is stored

    @property
    def is_text(self) -> bool:
        return self.dtype == "string"

    def path(self, index: int) -> str:
        return chunk_path(self.name, index, len(self.shape) - 1)


def parse_metadata(place: str, name: str, data: bytes) -> StoredArray:
    """Parse a zarr.json. InputError for metadata that datagen does not write."""
    try:
        meta = json.loads(data)
        dtype, shape, dims = meta["data_type"], tuple(meta["shape"]), tuple(meta["dimension_names"])
        chunk = file = tuple(meta["chunk_grid"]["configuration"]["chunk_shape"])
        codecs = meta["codecs"]
        if codecs[0]["name"] == "sharding_indexed":
            sharding = codecs[0]["configuration"]
            chunk, inner = tuple(sharding["chunk_shape"]), sharding["codecs"]
            index = [codec["name"] for codec in sharding["index_codecs"]], sharding["index_location"]
            if len(codecs) != 1 or index != (["bytes", "crc32c"], "end"):
                raise ValueError("unknown form of sharding")
            codecs = inner
        names = tuple(codec["name"] for codec in codecs)
        first = "vlen-utf8" if dtype == "string" else "bytes"
        if dtype != "string" and dtype not in _NUMBERS:
            raise ValueError(f"data type {dtype}")
        item_bytes = 1 if dtype == "string" else np.dtype(dtype).itemsize
        if item_bytes > 1 and codecs[0]["configuration"]["endian"] != "little":
            raise ValueError("not little-endian")
        if meta["zarr_format"] != 3 or names != (first, "zstd", "crc32c"):
            raise ValueError(f"codecs {names}")
        if meta["chunk_key_encoding"] != {"name": "default", "configuration": {"separator": "."}}:
            raise ValueError("unknown form of chunk keys")
        if dims[0] not in ("scene", "sample") or not len(dims) == len(shape) == len(chunk) == len(file):
            raise ValueError("dimensions do not match the shape")
        if not all(isinstance(x, int) and x > 0 for x in (*shape, *chunk, *file)):
            raise ValueError(f"chunks {chunk} of shape {shape}")
        if not chunk[1:] == file[1:] == shape[1:] or file[0] % chunk[0]:
            raise ValueError(f"chunks {chunk} of shape {shape}")
        if math.prod(chunk) * item_bytes > MAX_DECODED_BYTES or file[0] // chunk[0] > _MAX_PER_FILE:
            raise ValueError(f"chunks of {chunk}")
        per_file = file[0] // chunk[0] if codecs is not meta["codecs"] else 0
        attributes = dict(meta.get("attributes") or {})
        return StoredArray(name, dtype, shape, chunk[0], per_file, dims, attributes)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as e:
        problem = f"is not the metadata of a run's array ({type(e).__name__}: {e})"
        raise InputError(place, "", problem, DAMAGE_FIX) from e


@lru_cache(maxsize=16)
def arrays_of(schema: RecordSchema, layout: Layout) -> Mapping[str, StoredArray]:
    """The arrays of every shard of runs with this schema and layout, by name."""
    files = group_metadata(schema, layout, "")
    paths = {field.name: f"{field.name}/zarr.json" for _, field in schema.fields}
    return {name: parse_metadata(path, name, files[path]) for name, path in paths.items()}


def sources_of(names: Iterable[str], stored: Container[str]) -> list[str]:
    """The arrays to read for the named ones, of which a store may lack some that are computed."""
    known = ((name,) if name in stored else COMPUTED.get(name, (name,)) for name in names)
    return list(dict.fromkeys(name for each in known for name in each))


def readable(names: Iterable[str], stored: Mapping[str, StoredArray]) -> dict[str, StoredArray]:
    """The named arrays by name, with what those are computed from that the store lacks."""
    return {name: stored[name] if name in stored else _computed(name, stored) for name in names}


def _computed(name: str, stored: Mapping[str, StoredArray]) -> StoredArray:
    sources = tuple(stored[source] for source in COMPUTED[name])
    first = sources[0]
    like = replace(first, name=name, shape=first.shape[:1], dims=first.dims[:1])
    field = _FIELDS[name]
    return replace(like, dtype=field.dtype, attributes=field_attributes(field), computed_from=sources)


def decode_chunk(place: str, array: StoredArray, data: bytes) -> Array:
    """Decode a chunk's values, (chunk_rows, ...). InputError naming `place` for damaged bytes."""
    packed = data[:-4]
    if len(data) < 5 or not has_crc32c(data):
        raise InputError(place, array.name, "the crc32c does not match: the file is damaged", DAMAGE_FIX)
    shape = (array.chunk_rows, *array.shape[1:])
    count = math.prod(shape)
    try:
        if array.is_text:
            if _content_bytes(packed) > min(4 + count * (4 + MAX_TEXT_BYTES), MAX_DECODED_BYTES):
                raise ValueError("too much text")
            raw = Zstd().decode(packed)
            if int.from_bytes(raw[:4], "little") != count:  # before memory is allocated for them
                raise ValueError("another number of names")
            return VLenUTF8().decode(raw).reshape(shape)
        out = np.empty(shape, np.dtype(array.dtype).newbyteorder("<"))
        if _content_bytes(packed) != out.nbytes:
            raise ValueError(f"{_content_bytes(packed)} bytes")
        Zstd().decode(packed, out)
        return out
    except (ValueError, RuntimeError) as e:
        raise InputError(
            place, array.name, f"does not hold {shape} of {array.dtype} ({e})", DAMAGE_FIX
        ) from e


def has_crc32c(data: bytes) -> bool:
    """Whether data ends with the checksum of the rest, as Zarr's codec writes it."""
    return google_crc32c.value(data[:-4]) == int.from_bytes(data[-4:], "little")


def _content_bytes(frame: bytes) -> int:
    """Content size that a zstd frame's header states (RFC 8878, 3.1.1.1); ValueError if none."""
    if frame[:4] != b"\x28\xb5\x2f\xfd" or len(frame) < 6:
        raise ValueError("not a zstd frame")
    flags = frame[4]
    single_segment = flags >> 5 & 1
    start = 5 + (0 if single_segment else 1) + (0, 1, 2, 4)[flags & 3]
    width = (1 if single_segment else 0, 2, 4, 8)[flags >> 6]
    if width == 0 or len(frame) < start + width:
        raise ValueError("a zstd frame without content size")
    size = int.from_bytes(frame[start : start + width], "little")
    return size + 256 if width == 2 else size
