"""Read arrays directly from the chunks of committed shards or of a sealed store, one shard at a time.

The object of a committed shard is checked against its sha256 when a process first reads it, chunks against
their crc32c always. Works on any storage, without opening fifty arrays per shard by an array library.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Rows, Run
from datagen.schemas.run_records import Commit
from datagen.schemas.shard_sources import ShardObject, Source
from datagen.schemas.stored_arrays import DAMAGE_FIX, Array, StoredArray, decode_chunk


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

    def metadata(self, names: Sequence[str]) -> dict[str, StoredArray]:
        """Read the metadata of the named arrays. InputError for a missing, foreign or damaged file."""
        return self.source.metadata(names)

    def read(self, arrays: Iterable[StoredArray]) -> dict[str, Array]:
        """Read the wanted rows of each array. InputError for a missing, foreign or damaged file."""
        wanted = {array.name: array for array in arrays}
        parts: dict[str, list[Array]] = {name: [] for name in wanted}
        for array, place, data in self.chunks(wanted.values()):
            parts[array.name].append(decode_chunk(place, array, data))
        return {name: self._joined(array, parts[name]) for name, array in wanted.items()}

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


def committed_place(run: Run, commit: Commit, rows: Rows | None = None) -> ShardPlace:
    """The wanted rows [all] of a committed shard."""
    source = ShardObject(run, commit.object)
    wall_s = commit.cost.all_s["wall"] / max(commit.samples, 1)
    rows = Rows(0, commit.scenes, commit.samples) if rows is None else rows
    return ShardPlace(source, 0, rows, commit.scenes, commit.samples, wall_s)


def read_committed(
    run: Run, commit: Commit, names: Sequence[str], rows: Rows | None = None
) -> dict[str, Array]:
    """Read rows [all] of the named arrays of a committed shard. InputError as `ShardPlace.read`."""
    place = committed_place(run, commit, rows)
    return place.read(place.metadata(names).values())


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
    return read_committed(run, run.commit_of(shard), names)
