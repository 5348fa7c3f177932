"""Read scenes of a run from its committed shards: records and samples."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import Array, read_committed


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
