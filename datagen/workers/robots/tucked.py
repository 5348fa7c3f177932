"""Tucked poses of a robot, found by search: compact, free of self-collision, each unlike the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.tree import KinematicTree, frame_poses
from datagen.workers.robots.gripper import Parts

_LOOKED_AT, _BEST, _STEPS = 6000, 400, 6
_POSES, _LEAST_APART_RAD = 8, 0.7
_STEP = 0.1  # first step of the descent, as a share of the range
_FRONT = 0.5  # weight of what stands out to the front, where tables are


def tucked_poses(
    tree: KinematicTree,
    parts_m: Sequence[Parts],
    radius_m: float,
    floor_m: float,
    is_free: Callable[[F64], bool],
) -> F64:
    """Poses (H, A), the most compact first; empty where none of those looked at is free.

    Compact: little stands out of a circle of `radius_m` around the mount, less to the front; nothing comes
    within 10 cm of the floor at height `floor_m` in the base frame.
    """
    rng = np.random.Generator(np.random.PCG64(0))
    rows, corners = list[int](), list[F64]()
    for k, parts in enumerate(parts_m):
        if parts and tree.frame_joint[k] >= 0:
            points = np.concatenate(parts).astype(np.float64)
            low, high = points.min(axis=0), points.max(axis=0)
            corners.append(np.where((np.arange(8)[:, None] >> np.arange(3)) & 1, high, low))
            rows.append(k)
    boxes = np.array(corners)

    def cost(q: F64) -> F64:
        T = frame_poses(tree, q)[:, rows]
        points = np.einsum("mbij,bcj->mbci", T[..., :3, :3], boxes) + T[..., None, :3, 3]
        points = points.reshape(len(q), -1, 3)
        out = np.maximum(np.hypot(points[..., 0], points[..., 1]) - radius_m, 0.0)
        ahead = np.maximum(points[..., 0] - radius_m, 0.0)
        low = np.maximum(floor_m + 0.1 - points[..., 2], 0.0)
        return out.max(axis=1) + 0.3 * out.mean(axis=1) + _FRONT * ahead.max(axis=1) + 10 * low.max(axis=1)

    # Away from the limits, where paths begin with less freedom.
    low = tree.lower + 0.03 * (tree.upper - tree.lower)
    high = tree.upper - 0.03 * (tree.upper - tree.lower)
    q = rng.uniform(low, high, (_LOOKED_AT, len(low)))
    q = q[np.argsort(cost(q), kind="stable")[:_BEST]]
    found, step = cost(q), _STEP
    for _ in range(_STEPS):
        for _ in range(3):
            tried = np.clip(q + step * (high - low) * rng.standard_normal(q.shape), low, high)
            other = cost(tried)
            better = other < found
            q[better], found[better] = tried[better], other[better]
        step /= 1.5
    kept = list[F64]()
    for row in np.argsort(found, kind="stable"):
        apart = min((float(np.abs(q[row] - other).max()) for other in kept), default=np.inf)
        if apart > _LEAST_APART_RAD and is_free(q[row]):
            kept.append(q[row])
            if len(kept) == _POSES:
                break
    return np.array(kept).reshape(-1, len(low))
