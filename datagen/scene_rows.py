"""One scene of a run, read from its committed shard: its record and its samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.errors import InputError
from schemas.run import Run, shard_folder
from schemas.shard_reading import committed_place, read_metadata

Columns = dict[str, Any]


@dataclass(frozen=True, eq=False)
class SceneRows:
    """The scene's record by field name, and its samples' columns, one row a candidate."""

    record: Columns
    samples: Columns


def read_scene(run: Run, scene: int) -> SceneRows:
    """Scene `scene` of a run. InputError where it is not planned or its shard is not committed."""
    layout = run.layout
    scenes = -(-run.n // layout.candidates_per_scene)
    if not 0 <= scene < scenes:
        raise InputError(
            run.storage.url, "--scene", f"{scene} is not in this run", f"Choose one from 0 to {scenes - 1}"
        )
    shard, row = divmod(scene, layout.scenes_per_shard)
    if shard not in run.committed():
        raise InputError(
            run.storage.url,
            "--scene",
            f"{scene} lies in shard {shard}, which is not committed",
            "Resume the run, or choose another scene",
        )
    commit = run.commit_of(shard)
    folder = shard_folder(shard, commit.attempt)
    place = committed_place(run.storage, folder, commit, commit.scenes, commit.samples)
    names = [f.name for f in (*run.schema.scene_fields, *run.schema.sample_fields)]
    metadata = read_metadata(run.storage, folder, names)
    arrays = place.read(metadata.values())
    first = row * layout.candidates_per_scene
    rows = np.s_[first : first + layout.candidates_per_scene]
    return SceneRows(
        record={f.name: arrays[f.name][row] for f in run.schema.scene_fields},
        samples={f.name: arrays[f.name][rows] for f in run.schema.sample_fields},
    )
