"""Hand poses near other grasps: turned about the axis along which the fingers close, and moved on the pads.

Both fingers keep their contacts, so that most of these poses hold the object as the grasp does that they come
from. A floating hand decides, as for every grasp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from datagen.schemas.specification import MotionParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion.collision import Bools, Ints
from datagen.workers.motion.grasp_filter import free_grasps
from datagen.workers.motion.planning_scene import FreePoses, HandScene

_TURN_STD_RAD = np.radians(20)  # about the closing axis
# About the pads' width and about the approach, in each round and in all: within the contacts' friction cone.
_TILT_STD_RAD, _MOST_TILT_RAD = np.radians(3), np.radians(8)
# Along the pads' width and along the approach: less than half a pad.
_SHIFT_STD_M, _MOST_SHIFT_M = 0.003, 0.006


@dataclass(frozen=True, eq=False)
class NearbyPoses:
    """N poses of the TCP, each as a grasp and a motion in its frame."""

    T_world_grasp: F64  # (N, 4, 4)
    opening_m: F64  # (N,)
    turn_rad: F64  # (N,), about y, the closing axis
    tilt_rad: F64  # (N, 2), about x and z
    shift_m: F64  # (N, 2), along x and z

    @staticmethod
    def of_grasps(T_world_grasp: F64, opening_m: F64) -> NearbyPoses:
        """The grasps (N, 4, 4) themselves."""
        n = len(opening_m)
        return NearbyPoses(T_world_grasp, opening_m, np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2)))

    def rows(self, chosen: Ints) -> NearbyPoses:
        """Some of the poses, in the order given."""
        return NearbyPoses(
            self.T_world_grasp[chosen],
            self.opening_m[chosen],
            self.turn_rad[chosen],
            self.tilt_rad[chosen],
            self.shift_m[chosen],
        )

    def varied(self, each: int, rng: np.random.Generator) -> NearbyPoses:
        """`each` random poses near each of the poses."""
        some = self.rows(np.repeat(np.arange(len(self.opening_m)), each))
        n = len(some.opening_m)
        tilt_rad = some.tilt_rad + _TILT_STD_RAD * rng.standard_normal((n, 2))
        shift_m = some.shift_m + _SHIFT_STD_M * rng.standard_normal((n, 2))
        return replace(
            some,
            turn_rad=some.turn_rad + _TURN_STD_RAD * rng.standard_normal(n),
            tilt_rad=np.clip(tilt_rad, -_MOST_TILT_RAD, _MOST_TILT_RAD),
            shift_m=np.clip(shift_m, -_MOST_SHIFT_M, _MOST_SHIFT_M),
        )

    def T_world_tcp(self) -> F64:
        """The poses (N, 4, 4)."""
        T = self.T_world_grasp.copy()
        T[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, [0, 2]], self.shift_m)
        R = np.matmul(_rotations(1, self.turn_rad), _rotations(0, self.tilt_rad[:, 0]))
        T[:, :3, :3] = np.matmul(np.matmul(T[:, :3, :3], R), _rotations(2, self.tilt_rad[:, 1]))
        return T


def _rotations(axis: int, angle_rad: F64) -> F64:
    """Rotations (N, 3, 3) about one axis of the frame by angles (N,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle_rad), 1, 1))
    R[:, i, i], R[:, i, j], R[:, j, i], R[:, j, j] = c, -s, s, c
    return R


def scene_with_poses(around: HandScene, T_world_tcp: F64, opening_m: F64, params: MotionParams) -> HandScene:
    """The scene with these poses (K, 4, 4) and openings (K,) as its only grasps, checked on first use."""
    target = around.objects.rows(np.arange(around.target_parts))

    def check(rows: Ints) -> Bools:
        T, openings_m = T_world_tcp[rows], opening_m[rows]
        return free_grasps(around.hand, T, openings_m, around.near, target, params)

    T_object_tcp = np.matmul(inverse(around.T_world_target), T_world_tcp)
    every = np.arange(len(opening_m))
    return replace(
        around,
        grasps=around.grasps.with_poses(T_object_tcp, opening_m),
        grasp=every,
        T_world_tcp=T_world_tcp,
        opening_m=opening_m,
        is_free=FreePoses(len(every), check),
        kept=every,
        rest=every[:0],
    )
