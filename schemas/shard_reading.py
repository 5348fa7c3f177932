"""Arrays read straight from a run's chunk files: a whole shard at a time, every byte checked.

Works on committed shards and on a sealed store, on any storage, and needs no array library to open
fifty arrays a shard. What the files hold is taken from their own zarr.json, so that runs of older
schema versions read on.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import google_crc32c
import numpy as np
import numpy.typing as npt
from numcodecs.vlen import VLenUTF8
from numcodecs.zstd import Zstd

from schemas.errors import InputError
from schemas.run_records import Commit
from schemas.shard_files import MAX_TEXT_BYTES
from schemas.storage import Storage

Array = npt.NDArray[Any]

MAX_META_BYTES = 2**20
MAX_DECODED_BYTES = 2**30  # no chunk of ours comes near; a larger one is hostile
_MEND = "Restore the file from a copy, or mend the run with `datagen repair`"


@dataclass(frozen=True)
class StoredArray:
    """What an array's zarr.json says: rows and chunk rows lie along the first axis, `dims[0]`."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    chunk_rows: int
    dims: tuple[str, ...]
    attributes: Mapping[str, Any]

    @property
    def is_text(self) -> bool:
        """Whether it holds names instead of numbers."""
        return self.dtype == "string"


def parse_metadata(place: str, name: str, data: bytes) -> StoredArray:
    """The array described by a zarr.json. InputError unless it is one that this program writes."""
    try:
        meta = json.loads(data)
        dtype, shape, dims = meta["data_type"], tuple(meta["shape"]), tuple(meta["dimension_names"])
        chunk = tuple(meta["chunk_grid"]["configuration"]["chunk_shape"])
        codecs = tuple(codec["name"] for codec in meta["codecs"])
        first = "vlen-utf8" if dtype == "string" else "bytes"
        item_bytes = 1 if dtype == "string" else np.dtype(dtype).itemsize
        if dtype != "string" and np.dtype(dtype).kind not in "biuf":
            raise ValueError(f"data type {dtype}")
        if item_bytes > 1 and meta["codecs"][0]["configuration"]["endian"] != "little":
            raise ValueError("not little-endian")
        if meta["zarr_format"] != 3 or codecs != (first, "zstd", "crc32c"):
            raise ValueError(f"codecs {codecs}")
        if meta["chunk_key_encoding"] != {"name": "default", "configuration": {"separator": "."}}:
            raise ValueError("chunk keys of another form")
        if dims[0] not in ("scene", "sample") or not len(dims) == len(shape) == len(chunk):
            raise ValueError("dimensions that do not fit")
        if not all(isinstance(x, int) and x > 0 for x in (*shape, *chunk)) or chunk[1:] != shape[1:]:
            raise ValueError(f"chunks {chunk} of shape {shape}")
        if math.prod(chunk) * item_bytes > MAX_DECODED_BYTES:
            raise ValueError(f"chunks of {chunk}")
        return StoredArray(name, dtype, shape, chunk[0], dims, dict(meta.get("attributes") or {}))
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as e:
        problem = f"not the metadata of an array of a run ({type(e).__name__}: {e})"
        raise InputError(place, "", problem, _MEND) from e


def decode_chunk(place: str, array: StoredArray, data: bytes) -> Array:
    """A chunk's values, (chunk_rows, ...). InputError naming `place` when the bytes are damaged."""
    packed = data[:-4]
    if len(data) < 5 or google_crc32c.value(packed) != int.from_bytes(data[-4:], "little"):
        raise InputError(place, array.name, "the crc32c does not match: the file is damaged", _MEND)
    shape = (array.chunk_rows, *array.shape[1:])
    count = math.prod(shape)
    try:
        if array.is_text:
            if _content_bytes(packed) > min(4 + count * (4 + MAX_TEXT_BYTES), MAX_DECODED_BYTES):
                raise ValueError("more text than names can have")
            raw = Zstd().decode(packed)
            if int.from_bytes(raw[:4], "little") != count:  # before that many places are set aside
                raise ValueError("another number of names")
            return VLenUTF8().decode(raw).reshape(shape)
        out = np.empty(shape, np.dtype(array.dtype).newbyteorder("<"))
        if _content_bytes(packed) != out.nbytes:
            raise ValueError(f"{_content_bytes(packed)} bytes")
        Zstd().decode(packed, out)
        return out
    except (ValueError, RuntimeError) as e:
        raise InputError(place, array.name, f"does not hold {shape} of {array.dtype} ({e})", _MEND) from e


@dataclass(frozen=True)
class ShardPlace:
    """Where one shard's rows lie: in a committed attempt's folder, or as a slice of a sealed store.

    `ordinal` is the shard's place in the folder's arrays: 0 in its own folder. `scenes` and
    `samples` are the rows wanted of it; `sizes` are the committed file sizes where known.
    """

    storage: Storage
    folder: str
    ordinal: int
    scenes: int
    samples: int
    full_scenes: int
    full_samples: int
    sizes: Mapping[str, int] | None = None

    def read(self, arrays: Iterable[StoredArray]) -> dict[str, Array]:
        """The shard's rows of each array. InputError names a missing, foreign or damaged file."""
        wanted = list(arrays)
        chunks = [(array, path) for array in wanted for path in self._paths(array)]
        keys = (f"{self.folder}/{path}" if self.folder else path for _, path in chunks)
        parts: dict[str, list[Array]] = {array.name: [] for array in wanted}
        found = self.storage.get_many(keys, MAX_DECODED_BYTES)
        for (array, path), (key, data) in zip(chunks, found, strict=True):
            place = f"{self.storage.url}/{key}"
            self._refuse_other_size(place, path, array, data)
            parts[array.name].append(decode_chunk(place, array, data or b""))
        return {array.name: self._joined(array, parts[array.name]) for array in wanted}

    def _paths(self, array: StoredArray) -> list[str]:
        """Paths of the chunks that hold the wanted rows."""
        scene = array.dims[0] == "scene"
        full, rows = (self.full_scenes, self.scenes) if scene else (self.full_samples, self.samples)
        count = full // array.chunk_rows
        first = self.ordinal * count
        chunks = range(first, first + -(-rows // array.chunk_rows))
        return [f"{array.name}/" + ".".join(["c", str(i), *("0" for _ in array.shape[1:])]) for i in chunks]

    def _joined(self, array: StoredArray, parts: list[Array]) -> Array:
        whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return whole[: self.scenes if array.dims[0] == "scene" else self.samples]

    def _refuse_other_size(self, place: str, path: str, array: StoredArray, data: bytes | None) -> None:
        if data is None:
            raise InputError(place, array.name, "no such file, though it was committed", _MEND)
        if self.sizes is not None and self.sizes.get(path) != len(data):
            problem = f"{len(data)} bytes, where the commit has {self.sizes.get(path)}"
            raise InputError(place, array.name, problem, _MEND)


def committed_place(storage: Storage, folder: str, commit: Commit, scenes: int, samples: int) -> ShardPlace:
    """Where the wanted rows of a committed shard lie."""
    sizes = {entry.path: entry.size for entry in commit.files}
    return ShardPlace(storage, folder, 0, scenes, samples, commit.scenes, commit.samples, sizes)


def read_metadata(storage: Storage, folder: str, names: Iterable[str]) -> dict[str, StoredArray]:
    """The named arrays' metadata from a group's folder."""
    listed = list(names)
    keys = (f"{folder}/{name}/zarr.json" if folder else f"{name}/zarr.json" for name in listed)
    found: dict[str, StoredArray] = {}
    for name, (key, data) in zip(listed, storage.get_many(keys, MAX_META_BYTES), strict=True):
        if data is None:
            raise InputError(f"{storage.url}/{key}", "", "no such file", _MEND)
        found[name] = parse_metadata(f"{storage.url}/{key}", name, data)
    return found


def _content_bytes(frame: bytes) -> int:
    """Content size that a zstd frame's header states (RFC 8878, 3.1.1.1); ValueError if none."""
    if frame[:4] != b"\x28\xb5\x2f\xfd" or len(frame) < 6:
        raise ValueError("not a zstd frame")
    flags = frame[4]
    single_segment = flags >> 5 & 1
    start = 5 + (0 if single_segment else 1) + (0, 1, 2, 4)[flags & 3]
    width = (1 if single_segment else 0, 2, 4, 8)[flags >> 6]
    if width == 0 or len(frame) < start + width:
        raise ValueError("a zstd frame without its content size")
    size = int.from_bytes(frame[start : start + width], "little")
    return size + 256 if width == 2 else size
