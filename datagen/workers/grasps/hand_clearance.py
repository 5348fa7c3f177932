"""Collision checks of a hand on a straight approach, with the object and with the plane below it."""

# coal defines its names at import time, which type checkers do not see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.robots.gripper import Gripper
from datagen.workers.robots.hulls import polyhedron

Bools = npt.NDArray[np.bool_]

# Length of the approach, along which the hand is checked as one swept body.
APPROACH_M = 0.08


class HandClearance:
    """Collision checks of many poses of one hand with one object's convex parts, in a bounding-box tree."""

    def __init__(self, parts_m: Sequence[F32], gripper: Gripper) -> None:
        self._tree = coal.DynamicAABBTreeCollisionManager()
        # The tree keeps pointers only.
        self._object = [coal.CollisionObject(polyhedron(part)) for part in parts_m]
        for part in self._object:
            self._tree.registerObject(part)
        self._tree.setup()
        left, right = gripper.finger_parts_m
        self._hand = [
            (coal.CollisionObject(polyhedron(swept(part))), side)
            # The palm first: it collides most often.
            for parts, side in ((gripper.palm_parts_m, 0.0), (left, 0.5), (right, -0.5))
            for part in parts
        ]

    def free(self, T_object_tcp: F64, opening_m: F64 | F32) -> Bools:
        """Whether the hand, its approach included, is free of the object at each pose (N, 4, 4); (N,)."""
        return np.array(
            [self._is_free(T, float(o)) for T, o in zip(T_object_tcp, opening_m, strict=True)], bool
        )

    def _is_free(self, T: F64, opening_m: float) -> bool:
        R, p, y = T[:3, :3], T[:3, 3], T[:3, 1]
        callback = coal.CollisionCallBackDefault()
        for part, side in self._hand:
            part.setRotation(R)
            part.setTranslation(p + side * opening_m * y)
            part.computeAABB()
            self._tree.collide(part, callback)
            if callback.data.result.isCollision():
                return False
        return True


def swept(part_m: F32) -> F32:
    """Corners (2V, 3) of the hull that the part (V, 3) sweeps in its last `APPROACH_M` of approach."""
    return np.concatenate([part_m, part_m - np.array([0, 0, APPROACH_M], np.float32)])


def lowest_m(gripper: Gripper, T_object_tcp: F64, opening_m: F64 | F32) -> F64:
    """Lowest z (N,) of the hand in the object's frame, at the poses (N, 4, 4) and openings (N,)."""
    down = T_object_tcp[:, 2, :3]  # the object's z axis in the TCP frame
    left, right = gripper.finger_parts_m
    lowest = np.full(len(down), np.inf)
    for parts, side in ((left, 0.5), (right, -0.5), (gripper.palm_parts_m, 0.0)):
        shift = side * np.asarray(opening_m, np.float64) * down[:, 1]
        for part in parts:
            lowest = np.minimum(lowest, (down @ swept(part).T.astype(np.float64)).min(axis=1) + shift)
    return lowest + T_object_tcp[:, 2, 3]
