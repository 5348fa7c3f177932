"""Read arrays directly from a run's chunk files, one shard at a time, with checksums.

A committed file is checked against its sha256 when a process first reads it, and against its crc32c always.
Works for committed shards and sealed stores, on any storage, without opening fifty arrays per shard by an
array library. Types and shapes come from the files' own zarr.json, so that runs of older schema versions
stay readable.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import google_crc32c
import numpy as np
import numpy.typing as npt
from numcodecs.vlen import VLenUTF8
from numcodecs.zstd import Zstd

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.schemas.record_files import shard_folder
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.shard_files import MAX_TEXT_BYTES
from datagen.schemas.storage import Storage

Array = npt.NDArray[Any]

MAX_META_BYTES = 2**20
MAX_DECODED_BYTES = 2**30  # far above any real chunk
_CHECKED = b""
_FIX = "Restore the file from a copy, or set the shard aside with `datagen verify --repair`"


@dataclass(frozen=True)
class StoredArray:
    """Metadata of an array; rows and chunk rows are along the first axis, `dims[0]`."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    chunk_rows: int
    dims: tuple[str, ...]
    attributes: Mapping[str, Any]

    @property
    def is_text(self) -> bool:
        return self.dtype == "string"


def parse_metadata(place: str, name: str, data: bytes) -> StoredArray:
    """Parse a zarr.json. InputError for metadata that datagen does not write."""
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
            raise ValueError("unknown form of chunk keys")
        if dims[0] not in ("scene", "sample") or not len(dims) == len(shape) == len(chunk):
            raise ValueError("dimensions do not match the shape")
        if not all(isinstance(x, int) and x > 0 for x in (*shape, *chunk)) or chunk[1:] != shape[1:]:
            raise ValueError(f"chunks {chunk} of shape {shape}")
        if math.prod(chunk) * item_bytes > MAX_DECODED_BYTES:
            raise ValueError(f"chunks of {chunk}")
        return StoredArray(name, dtype, shape, chunk[0], dims, dict(meta.get("attributes") or {}))
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as e:
        problem = f"is not the metadata of a run's array ({type(e).__name__}: {e})"
        raise InputError(place, "", problem, _FIX) from e


def decode_chunk(place: str, array: StoredArray, data: bytes) -> Array:
    """Decode a chunk's values, (chunk_rows, ...). InputError naming `place` for damaged bytes."""
    packed = data[:-4]
    if len(data) < 5 or google_crc32c.value(packed) != int.from_bytes(data[-4:], "little"):
        raise InputError(place, array.name, "the crc32c does not match: the file is damaged", _FIX)
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
        raise InputError(place, array.name, f"does not hold {shape} of {array.dtype} ({e})", _FIX) from e


@dataclass(frozen=True)
class ShardPlace:
    """Location of one shard's rows: a committed attempt's folder, or a slice of a sealed store.

    `ordinal` is the shard's position in the folder's arrays: 0 in its own folder. `scenes` and `samples` are
    its wanted rows. `digests` has the sha256 of committed files by path, "" once checked; None without
    commit. `wall_s_per_sample` is the time of the attempt over its number of samples; NaN without commit.
    """

    storage: Storage
    folder: str
    ordinal: int
    scenes: int
    samples: int
    full_scenes: int
    full_samples: int
    digests: dict[str, bytes] | None = None
    wall_s_per_sample: float = math.nan

    def metadata(self, names: Iterable[str]) -> dict[str, StoredArray]:
        """Read the metadata of the named arrays. InputError for a missing, foreign or damaged file."""
        found: dict[str, StoredArray] = {}
        paths = [f"{name}/zarr.json" for name in names]
        for path, place, data in self._files(paths, MAX_META_BYTES):
            name = path.removesuffix("/zarr.json")
            found[name] = parse_metadata(place, name, data)
        return found

    def read(self, arrays: Iterable[StoredArray]) -> dict[str, Array]:
        """Read the shard's rows of each array. InputError for a missing, foreign or damaged file."""
        wanted = {array.name: array for array in arrays}
        paths = [path for array in wanted.values() for path in self._paths(array)]
        parts: dict[str, list[Array]] = {name: [] for name in wanted}
        for path, place, data in self._files(paths, MAX_DECODED_BYTES):
            name = path.partition("/")[0]
            parts[name].append(decode_chunk(place, wanted[name], data))
        return {name: self._joined(array, parts[name]) for name, array in wanted.items()}

    def _files(self, paths: Sequence[str], most: int) -> Iterator[tuple[str, str, bytes]]:
        """Yield (path, address, bytes) of files, checked against the commit if there is one."""
        keys = (f"{self.folder}/{path}" if self.folder else path for path in paths)
        for path, (key, data) in zip(paths, self.storage.get_many(keys, most), strict=True):
            place, name = f"{self.storage.url}/{key}", path.partition("/")[0]
            if data is None:
                raise InputError(place, name, "no such file", _FIX)
            if self.digests is not None and (digest := self.digests.get(path)) != _CHECKED:
                if sha256(data).digest() != digest:
                    problem = f"has {len(data)} bytes with another sha256 than the commit"
                    raise InputError(place, name, problem, _FIX)
                self.digests[path] = _CHECKED
            yield path, place, data

    def _paths(self, array: StoredArray) -> list[str]:
        scene = array.dims[0] == "scene"
        full, rows = (self.full_scenes, self.scenes) if scene else (self.full_samples, self.samples)
        count = full // array.chunk_rows
        first = self.ordinal * count
        chunks = range(first, first + -(-rows // array.chunk_rows))
        return [f"{array.name}/" + ".".join(["c", str(i), *("0" for _ in array.shape[1:])]) for i in chunks]

    def _joined(self, array: StoredArray, parts: list[Array]) -> Array:
        whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
        # Half floats are point clouds, slow to check; an error in them shows in a loss or a score.
        if whole.dtype.kind == "f" and whole.itemsize > 2 and not np.isfinite(whole).all():
            place = f"{self.storage.url}/{self.folder}"
            raise InputError(place, array.name, "holds NaN or infinite numbers", _FIX)
        return whole[: self.scenes if array.dims[0] == "scene" else self.samples]


def committed_place(
    storage: Storage, commit: Commit, names: Iterable[str], scenes: int, samples: int
) -> ShardPlace:
    """Location of the wanted rows of a committed shard, for these arrays."""
    wanted, folder = set(names), shard_folder(commit.shard, commit.attempt)
    # Interned: all shards of a run have files of the same names.
    digests = {
        sys.intern(entry.path): bytes.fromhex(entry.sha256)
        for entry in commit.files
        if entry.path.partition("/")[0] in wanted
    }
    wall_s = commit.cost.all_s["wall"] / max(commit.samples, 1)
    return ShardPlace(storage, folder, 0, scenes, samples, commit.scenes, commit.samples, digests, wall_s)


def read_committed(storage: Storage, commit: Commit, names: Sequence[str]) -> dict[str, Array]:
    """Read all rows of the named arrays of a committed shard. InputError as `ShardPlace.read`."""
    place = committed_place(storage, commit, names, commit.scenes, commit.samples)
    return place.read(place.metadata(names).values())


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


def read_scene(run: Run, scene: int) -> SceneRows:
    """Read scene `scene` of a run. InputError where it is not planned or its shard is not committed."""
    scenes = -(-run.n // run.layout.candidates_per_scene)
    if not 0 <= scene < scenes:
        raise InputError(
            run.storage.url, "--scene", f"{scene} is not in this run", f"Give one from 0 to {scenes - 1}"
        )
    shard = scene // run.layout.scenes_per_shard
    if shard not in run.committed():
        raise InputError(
            run.storage.url,
            "--scene",
            f"{scene} is in shard {shard}, which is not committed",
            "Resume the run, or choose another scene",
        )
    return next(read_scenes(run, [scene]))


def read_scenes(run: Run, scenes: Iterable[int]) -> Iterator[SceneRows]:
    """Read the scenes of these indices, in order; consecutive ones of a shard are read together.

    Scenes beyond the run's n are included where their shard is committed. InputError for a scene whose shard
    is not committed or damaged.
    """
    per_shard, per_scene = run.layout.scenes_per_shard, run.layout.candidates_per_scene
    loaded, arrays = -1, dict[str, Array]()
    for scene in scenes:
        shard, row = divmod(scene, per_shard)
        if shard != loaded:
            loaded, arrays = shard, read_shard(run, shard)
        rows = np.s_[row * per_scene : (row + 1) * per_scene]
        yield SceneRows(
            record={f.name: arrays[f.name][row] for f in run.schema.scene_fields},
            samples={f.name: arrays[f.name][rows] for f in run.schema.sample_fields},
        )


def committed_scenes(run: Run) -> int:
    """Number of scenes before the first missing shard, including those beyond n in the last shard."""
    committed = run.committed()
    shards = next(k for k in range(len(committed) + 1) if k not in committed)
    return shards * run.layout.scenes_per_shard


def read_shard(run: Run, shard: int) -> dict[str, Array]:
    """Read all rows of every array of a committed shard. InputError for a missing or damaged file."""
    names = [f.name for f in (*run.schema.scene_fields, *run.schema.sample_fields)]
    return read_committed(run.storage, run.commit_of(shard), names)
