"""The short columns of a run: its candidates around the target, their labels and causes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.shard_reading import read_committed
from datagen.workers.bases.candidate_sets import within_reach

Array = npt.NDArray[Any]
Bools = npt.NDArray[np.bool_]
F64 = npt.NDArray[np.float64]

MOST_SHARDS = 256
_SCENE = ("scene_index", "T_world_camera", "target_center_m")
_SAMPLE = (
    *("sample_scene_index", "base_xy_m", "label", "base_is_clear", "distance_m", "mount_distance_m"),
    "arm_reach_m",
)


@dataclass(frozen=True, eq=False)
class RunColumns:
    """N candidates of a run, within its n, in S scenes.

    `offset_m` (N, 2) is the base from the target, with the observation camera on the side of -y. `outcome`
    (N,) has codes of OUTCOMES, and is None for labels without outcomes. `shards` are those that were read, of
    all committed `of`.
    """

    scenes: npt.NDArray[np.int64]  # (S,), indices
    label: Bools
    is_clear: Bools
    is_within_reach: Bools
    distance_m: F64
    offset_m: F64
    outcome: Array | None
    shards: int
    of: int

    @property
    def is_near(self) -> Bools:
        """Mask (N,) of the candidates where the base fits and the target is within reach."""
        return self.is_clear & self.is_within_reach

    def causes(self) -> dict[str, Bools]:
        """Masks (N,) of all candidates by cause, good ones first; each candidate has one."""
        good, clear, reached = self.label, self.is_clear, self.is_within_reach
        if self.outcome is not None:
            return {name: self.outcome == code for code, name in enumerate(OUTCOMES)}
        return {
            "good, and the base fits within reach": good & self.is_near,
            "good, but the base collides": good & ~clear,
            "good, but out of reach": good & clear & ~reached,
            "bad: the score is below the threshold": ~good,
        }


def read_columns(run: Run) -> RunColumns | None:
    """The columns of all committed shards, or of 256 evenly spaced ones; None without any."""
    n = run.n
    committed = run.planned(n).within(ShardRanges.of(run.committed()))
    chosen = np.unique(np.linspace(0, len(committed) - 1, min(MOST_SHARDS, len(committed))).astype(int))
    has_outcome = any(field.name == "outcome" for field in run.schema.sample_fields)
    names = (*_SAMPLE, "outcome") if has_outcome else _SAMPLE
    read: list[dict[str, Array]] = []
    for k in chosen.tolist():
        rows = run.rows_of(committed[k], n)
        read.append(read_committed(run, run.commit_of(committed[k]), (*_SCENE, *names), rows))
    if not read:
        return None
    joined = {name: np.concatenate([shard[name] for shard in read]) for name in read[0]}
    scene = np.searchsorted(joined["scene_index"], joined["sample_scene_index"])
    return RunColumns(
        scenes=joined["scene_index"].astype(np.int64),
        label=joined["label"] == 1,
        is_clear=joined["base_is_clear"] == 1,
        is_within_reach=within_reach(
            run.manifest.spec.candidates, joined["mount_distance_m"], joined["arm_reach_m"]
        ),
        distance_m=joined["distance_m"].astype(np.float64),
        offset_m=turned(joined, scene),
        outcome=joined.get("outcome"),
        shards=len(read),
        of=len(committed),
    )


def turned(joined: dict[str, Array], scene: npt.NDArray[np.int64]) -> F64:
    """Bases (N, 2) from their target, in axes in which the camera looks along +y."""
    target = joined["target_center_m"][:, :2].astype(np.float64)
    towards = target - joined["T_world_camera"][:, :2, 3]
    ahead = (towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9))[scene]
    offset = joined["base_xy_m"].astype(np.float64) - target[scene]
    right = np.column_stack([ahead[:, 1], -ahead[:, 0]])
    return np.column_stack([(offset * right).sum(1), (offset * ahead).sum(1)])
