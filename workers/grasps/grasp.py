"""Grasps of one object by one gripper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from datagen.workers.geometry.mesh import F32, F64


@dataclass(frozen=True, eq=False)
class GraspSet:
    """G grasps, best first. The TCP frame is the gripper's (`datagen.workers.robots.gripper.Gripper`).

    Scores are shares of floating-hand pulls that held, 0 to 1. The scores of the first S grasps are known and
    at least `min_score`. Each other score is computed on first use and may be lower.
    """

    T_object_tcp: F64  # (G, 4, 4)
    opening_m: F32  # (G,), of the hand on its approach: the object's width there plus a gap
    score: F32  # (S,)
    min_score: float = 0.0
    later_score: Callable[[int], float] | None = None  # by row - S

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
