"""Read arrays directly from the chunks of committed shards or of a sealed store, one shard at a time.

The object of a committed shard is checked against its sha256 when a process first reads it, chunks against
their crc32c always. Works on any storage, without opening fifty arrays per shard by an array library.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS, SceneRows, facing_rad
from datagen.schemas.run import Rows, Run
from datagen.schemas.run_records import Commit
from datagen.schemas.safe_files import DAMAGED_ZIP
from datagen.schemas.storage import Storage
from datagen.schemas.stored_arrays import (
    DAMAGE_FIX,
    MAX_DECODED_BYTES,
    MAX_META_BYTES,
    Array,
    StoredArray,
    decode_chunk,
    has_crc32c,
    parse_metadata,
    readable,
    sources_of,
)

Wanted = Sequence[tuple[StoredArray, int]]  # chunks, each as its array and its index there


class Source(Protocol):
    """Where arrays lie: `chunks` are (address, bytes), in the order of the wanted ones.

    InputError for a missing, foreign or damaged file.
    """

    @property
    def url(self) -> str: ...
    def metadata(self, names: Sequence[str]) -> dict[str, StoredArray]: ...
    def chunks(self, wanted: Wanted) -> Iterator[tuple[str, bytes]]: ...


@dataclass(eq=False)
class ZipSource:
    """A source whose files are in one zip, which `open` reads."""

    url: str
    open: Callable[[], ZipFiles]

    def metadata(self, names: Sequence[str]) -> dict[str, StoredArray]:
        files, paths = self.open(), {name: f"{name}/zarr.json" for name in names}
        return {
            name: parse_metadata(f"{self.url}/{path}", name, files.get(path)) for name, path in paths.items()
        }

    def chunks(self, wanted: Wanted) -> Iterator[tuple[str, bytes]]:
        files = self.open()
        for path in (array.path(index) for array, index in wanted):
            yield f"{self.url}/{path}", files.get(path)


# OverflowError: an offset that no file has.
_DAMAGED = (*DAMAGED_ZIP, OverflowError)


class ZipFiles:
    """The files in a shard's object or a zipped store. InputError where it is no such zip or lacks a file."""

    def __init__(self, place: str, data: bytes) -> None:
        self.place = place
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(data))
        except _DAMAGED as e:
            raise InputError(place, "", f"is not a zip of arrays ({e})", DAMAGE_FIX) from e
        self.paths = [entry.filename for entry in self._zip.infolist()]

    def get(self, path: str) -> bytes:
        try:
            entry = self._zip.getinfo(path)
            if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                raise zipfile.BadZipFile("compressed or encrypted")
            return self._zip.read(entry)
        except KeyError as e:
            raise InputError(f"{self.place}/{path}", "", "no such file", DAMAGE_FIX) from e
        except _DAMAGED as e:
            raise InputError(f"{self.place}/{path}", "", f"is damaged ({e})", DAMAGE_FIX) from e


@dataclass(eq=False)
class StoreFiles:
    """A sealed store, in whose files the chunks of many shards lie behind an index."""

    storage: Storage
    _indices: dict[str, npt.NDArray[np.uint64]] = field(default_factory=dict)

    @property
    def url(self) -> str:
        return self.storage.url

    def metadata(self, names: Sequence[str]) -> dict[str, StoredArray]:
        found: dict[str, StoredArray] = {}
        keys = [f"{name}/zarr.json" for name in names]
        for name, (key, data) in zip(names, self.storage.get_many(keys, MAX_META_BYTES), strict=True):
            if data is None:
                raise InputError(f"{self.url}/{key}", name, "no such file", DAMAGE_FIX)
            found[name] = parse_metadata(f"{self.url}/{key}", name, data)
        return found

    def chunks(self, wanted: Wanted) -> Iterator[tuple[str, bytes]]:
        return self.storage.concurrent_map(lambda one: self._chunk(*one), wanted)

    def _chunk(self, array: StoredArray, index: int) -> tuple[str, bytes]:
        file, inner = divmod(index, array.per_file) if array.per_file else (index, 0)
        key = array.path(file)
        place = f"{self.url}/{key}"
        if not array.per_file:
            data = self.storage.get(key, MAX_DECODED_BYTES)
        else:
            start, size = (int(number) for number in self._index(key, array)[inner])
            if start + size > 2**50 or not 0 < size <= MAX_DECODED_BYTES:
                raise InputError(place, array.name, "its index names a chunk that cannot be", DAMAGE_FIX)
            data = self.storage.get_range(key, start, size)
        if data is None:
            raise InputError(place, array.name, "no such file", DAMAGE_FIX)
        return place, data

    def _index(self, key: str, array: StoredArray) -> npt.NDArray[np.uint64]:
        if key not in self._indices:
            size = 16 * array.per_file + 4
            data = self.storage.get_range(key, -size, size)
            if data is None or len(data) != size or not has_crc32c(data):
                problem = "its index is missing or damaged"
                raise InputError(f"{self.url}/{key}", array.name, problem, DAMAGE_FIX)
            self._indices[key] = np.frombuffer(data[:-4], "<u8").reshape(-1, 2)
        return self._indices[key]


@dataclass(frozen=True)
class ShardPlace:
    """One shard's rows: `rows` of them are wanted.

    `ordinal` is the shard's position in the source's arrays: 0 in its own object. `wall_s_per_sample` is the
    time of the attempt over its number of samples; NaN without commit.
    """

    source: Source
    ordinal: int
    rows: Rows
    full_scenes: int
    full_samples: int
    wall_s_per_sample: float = math.nan

    @property
    def scenes(self) -> int:
        return self.rows.scenes

    @property
    def samples(self) -> int:
        return self.rows.samples

    @property
    def url(self) -> str:
        return self.source.url

    def read(self, arrays: Iterable[StoredArray]) -> dict[str, Array]:
        """Read the wanted rows of each array. InputError for a missing, foreign or damaged file."""
        asked = list(arrays)
        wanted = {array.name: array for each in asked for array in each.computed_from or (each,)}
        parts: dict[str, list[Array]] = {name: [] for name in wanted}
        for array, place, data in self.chunks(wanted.values()):
            parts[array.name].append(decode_chunk(place, array, data))
        read = {name: self._joined(array, parts[name]) for name, array in wanted.items()}
        return {
            each.name: self._computed(each, read) if each.computed_from else read[each.name] for each in asked
        }

    def _computed(self, array: StoredArray, read: Mapping[str, Array]) -> Array:
        if array.name != "base_yaw_rad":
            return np.zeros(len(read[array.computed_from[0].name]), array.dtype)
        # Bases of stores without headings face the target.
        scene = np.arange(self.samples) // (self.full_samples // self.full_scenes)
        return facing_rad(read["target_center_m"][scene, :2] - read["base_xy_m"]).astype(np.float32)

    def chunks(self, arrays: Iterable[StoredArray]) -> Iterator[tuple[StoredArray, str, bytes]]:
        """Yield the encoded chunks that hold the wanted rows: array, address, bytes."""
        wanted = [(array, index) for array in arrays for index in self._chunks(array)]
        found = self.source.chunks(wanted)
        return ((array, *chunk) for (array, _), chunk in zip(wanted, found, strict=True))

    def _span(self, array: StoredArray) -> tuple[int, int, int]:
        """First and one past the last wanted row within the shard, and the rows of a whole one."""
        rows, each = self.rows, self.full_samples // max(self.full_scenes, 1)
        if array.dims[0] == "scene":
            return rows.first, rows.first + rows.scenes, self.full_scenes
        return rows.first * each, rows.first * each + rows.samples, self.full_samples

    def _chunks(self, array: StoredArray) -> range:
        first, past, full = self._span(array)
        before = self.ordinal * (full // array.chunk_rows)
        return range(before + first // array.chunk_rows, before - (-past // array.chunk_rows))

    def _joined(self, array: StoredArray, parts: list[Array]) -> Array:
        whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
        # Half floats are point clouds, slow to check; an error in them shows in a loss or a score.
        if whole.dtype.kind == "f" and whole.itemsize > 2 and not np.isfinite(whole).all():
            raise InputError(self.url, array.name, "holds NaN or infinite numbers", DAMAGE_FIX)
        first, past, _ = self._span(array)
        start = first // array.chunk_rows * array.chunk_rows
        return whole[first - start : past - start]


@dataclass(eq=False)
class _ObjectFiles:
    """Reads the object of a committed shard. Its sha256 is checked the first time."""

    run: Run
    commit: Commit
    url: str
    is_checked: bool = False

    def __call__(self) -> ZipFiles:
        data = self.run.read_object(self.commit, check=not self.is_checked)
        self.is_checked = True
        return ZipFiles(self.url, data)


def committed_place(run: Run, commit: Commit, rows: Rows | None = None) -> ShardPlace:
    """The wanted rows [all] of a committed shard."""
    url = f"{run.storage.url}/shards/{commit.object.path}"
    wall_s = commit.cost.all_s["wall"] / max(commit.samples, 1)
    rows = Rows(0, commit.scenes, commit.samples) if rows is None else rows
    source = ZipSource(url, _ObjectFiles(run, commit, url))
    return ShardPlace(source, 0, rows, commit.scenes, commit.samples, wall_s)


def read_committed(
    run: Run, commit: Commit, names: Sequence[str], rows: Rows | None = None
) -> dict[str, Array]:
    """Read rows [all] of the named arrays of a committed shard. InputError as `ShardPlace.read`."""
    place = committed_place(run, commit, rows)
    stored = [f.name for _, f in run.schema.fields]
    arrays = readable(names, place.source.metadata(sources_of(names, stored)))
    return place.read(arrays.values())


def read_scene(run: Run, scene: int) -> SceneRows:
    """Read one scene. InputError as `read_scenes`."""
    return next(read_scenes(run, [scene]))


def read_scenes(run: Run, scenes: Iterable[int]) -> Iterator[SceneRows]:
    """Read the scenes of these indices, in order; consecutive ones of a shard are read together.

    Scenes beyond the run's n are included where their shard is committed. InputError for a scene whose shard
    is not committed or damaged.
    """
    per_shard, per_scene = run.layout.scenes_per_shard, run.layout.candidates_per_scene
    schema, loaded, arrays = SCHEMAS[run.schema.name], -1, dict[str, Array]()
    for scene in scenes:
        shard, row = divmod(scene, per_shard)
        if shard != loaded:
            loaded, arrays = shard, read_shard(run, shard)
        rows = np.s_[row * per_scene : (row + 1) * per_scene]
        yield SceneRows(
            record={f.name: arrays[f.name][row] for f in schema.scene_fields},
            samples={f.name: arrays[f.name][rows] for f in schema.sample_fields},
        )


def read_shard(run: Run, shard: int) -> dict[str, Array]:
    """Read all rows of every array of a committed shard. InputError for a missing or damaged file."""
    return read_committed(run, run.commit_of(shard), [f.name for _, f in SCHEMAS[run.schema.name].fields])
