"""Grasps of one object by one gripper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from datagen.workers.geometry.mesh import F32, F64


@dataclass(frozen=True, eq=False)
class GraspSet:
    """G grasps, best first. The TCP frame is the gripper's (`datagen.workers.robots.gripper.Gripper`).

    Scores are shares of floating-hand pulls that held, 0 to 1. The scores of the first S grasps are known and
    at least `min_score`. Each other score is computed on first use and may be lower. `pose_score` gives that
    of any pose (4, 4) in the object's frame and opening.
    """

    T_object_tcp: F64  # (G, 4, 4)
    opening_m: F32  # (G,), of the hand on its approach: the object's width there plus a gap
    score: F32  # (S,)
    min_score: float = 0.0
    later_score: Callable[[int], float] | None = None  # by row - S
    pose_score: Callable[[F64, float], float] | None = None

    def __len__(self) -> int:
        return len(self.opening_m)

    def score_of(self, row: int) -> float:
        """The score of one grasp."""
        if row < len(self.score):
            return float(self.score[row])
        assert self.later_score is not None
        return self.later_score(row - len(self.score))

    def holds(self, row: int) -> bool:
        """Whether the grasp has at least `min_score`."""
        return row < len(self.score) or self.score_of(row) >= self.min_score

    def with_poses(self, T_object_tcp: F64, opening_m: F64) -> GraspSet:
        """Other poses (G, 4, 4) of the hand at the same object, none of them scored yet."""
        pose_score = self.pose_score
        assert pose_score is not None

        def later_score(row: int) -> float:
            return pose_score(T_object_tcp[row], float(opening_m[row]))

        openings = opening_m.astype(np.float32)
        return GraspSet(T_object_tcp, openings, self.score[:0], self.min_score, later_score, pose_score)
