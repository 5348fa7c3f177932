"""Grasps of one object by one gripper."""

from __future__ import annotations

from dataclasses import dataclass

from datagen.workers.geometry.mesh import F32, F64


@dataclass(frozen=True, eq=False)
class GraspSet:
    """G grasps, best first. The TCP frame is the gripper's (`datagen.workers.robots.gripper.Gripper`)."""

    T_object_tcp: F64  # (G, 4, 4)
    opening_m: F32  # (G,), at which the hand comes in: the object's width there and some air
    score: F32  # (G,), share of floating-hand trials that lifted and held, 0 to 1

    def __len__(self) -> int:
        return len(self.score)
