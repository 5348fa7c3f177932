"""Labels of runs as arrays, from all committed shards."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from datagen.reports.agreement import ROWS, Labelled
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import Array, read_committed

_COLUMNS = {
    "sample_scene_index": "scene",
    "candidate_index": "candidate",
    "label": "label",
    "base_is_clear": "is_clear",
    "distance_m": "distance_m",
    "mount_distance_m": "mount_distance_m",
    "visibility": "visibility",
    "arm_reach_m": "reach_m",
    "base_height_m": "height_m",
}


def read_labelled(run: Run) -> Labelled | None:
    """Read all committed candidates of a run, also those beyond n; None where there are none.

    InputError for a missing, foreign or damaged file.
    """
    has_outcome = any(f.name == "outcome" for f in run.schema.sample_fields)
    names = [*_COLUMNS, "object_name", *(["outcome"] if has_outcome else [])]
    shards = [_read(run, shard, names) for shard in sorted(run.committed())]
    if not shards:
        return None
    per_scene = run.layout.candidates_per_scene

    def joined(parts: Iterable[Array]) -> Any:
        return np.concatenate(list(parts))

    columns = {to: joined(shard[name] for shard in shards) for name, to in _COLUMNS.items()}
    columns["label"] = columns["label"].astype(np.bool_)
    return Labelled(
        **columns,
        target=joined(np.repeat(shard["object_name"][:, 0], per_scene) for shard in shards),
        outcome=joined(shard["outcome"] for shard in shards) if has_outcome else None,
    )


def join_labelled(parts: list[Labelled]) -> Labelled:
    """Join candidates of several runs of one schema."""
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ROWS}
    outcomes = [part.outcome for part in parts if part.outcome is not None]
    return Labelled(**rows, outcome=np.concatenate(outcomes) if outcomes else None)


def _read(run: Run, shard: int, names: list[str]) -> dict[str, Array]:
    return read_committed(run.storage, run.commit_of(shard), names)
