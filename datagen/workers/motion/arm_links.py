"""Where an arm's links are while its hand is near a pose: one random joint vector for each cell of its map.

Links are spheres, so that a model can ask an observed cloud how much room they have. All is NumPy: a model
scores without a compiler, and for registered robots without their URDFs.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import sha256
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from datagen.workers.content_cache import CacheFolder, version_of
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.kinematics.tree import KinematicTree, frame_poses
from datagen.workers.motion.pose_reach import PoseReach, known_arm, pose_reach
from datagen.workers.motion.reach_cells import AZIMUTHS, CELLS, DISTANCES, HEIGHTS, cells_of

Ints = npt.NDArray[np.int64]

_SAMPLES = 1 << 17
_AT_ONCE = 1 << 13  # bounds memory
_LEAST_RADIUS_M, _MOST_SPHERES = 0.015, 5  # of a link
TREE, RADIUS = "tree.", "radius_m"  # fields of a registered robot
_CACHE = CacheFolder("arm-links-1", most_files=32)  # 6 to 16 MB each; 1: version of `_sampled`


class ArmLinks(NamedTuple):
    """C joint vectors, in order of their cells, and the B spheres of the links at each.

    The hand is turned to the front: wrist and spheres are seen from the upright axis of the arm, if it has
    one, and from its base otherwise.
    """

    cell: Ints  # (C,)
    wrist_m: F64  # (C, 2), distance and height
    turn_rad: F64  # (C,), of the upright joint
    center_m: npt.NDArray[np.float16]  # (C, B, 3)
    radius_m: F64  # (B,)
    along: F64  # (B,), share of the joints between base and wrist that move the sphere
    turn_limits_rad: F64  # (2,)
    half_m: F64  # (), of the map: scaled arms have another


@lru_cache(maxsize=16)
def arm_links(name: str) -> ArmLinks:
    """Those of a robot, by its name or file, of its largest size. InputError as `open_robot`."""
    if known := known_arm(name):
        tree = KinematicTree(*(known[TREE + field] for field in KinematicTree._fields))
        radius_m, reach_m = known[RADIUS], float(known["reach_m"][-1])
    else:  # imported here: needs the compiler
        from datagen.workers.motion.measured_reach import link_spheres, reaches_of

        (tree, radius_m), reach_m = link_spheres(name), float(reaches_of(name)[-1])
    arm = pose_reach(name, reach_m)
    parts = b"-".join(np.asarray(part).tobytes() for part in (*tree, radius_m, *arm))
    key = f"{sha256(parts).hexdigest()}-{version_of('numpy')}"
    return ArmLinks(**_CACHE.computed(key, lambda: _sampled(tree, radius_m, arm)._asdict()))


def _sampled(tree: KinematicTree, radius_m: F64, arm: PoseReach) -> ArmLinks:
    low = np.minimum(np.maximum(-np.pi, tree.lower), np.maximum(tree.lower, tree.upper - 2 * np.pi))
    high = np.minimum(tree.upper, low + 2 * np.pi)  # at most one turn
    q = np.random.Generator(np.random.PCG64(0)).uniform(low, high, (_SAMPLES, len(low)))
    cell = np.empty(len(q), np.int64)
    wrist_m, azimuth = np.empty((len(q), 2)), np.empty(len(q))
    for some in _slices(len(q)):
        T = frame_poses(tree, q[some], tcp_only=True)[:, 0]
        at = (T[:, :3, :3] @ arm.tcp_wrist_m + T[:, :3, 3]) - [*arm.axis_xy_m, 0.0]
        azimuth[some] = np.arctan2(at[:, 1], at[:, 0])
        wrist_m[some] = np.column_stack([np.hypot(at[:, 0], at[:, 1]), at[:, 2]])
        approach, closing = (to_front(azimuth[some], T[:, :3, k].T) for k in (2, 1))
        direction = cells_of(approach, closing, None if arm.turns else azimuth[some])
        cell[some] = cells_at(arm, wrist_m[some, 0], wrist_m[some, 1], direction)
    cell, chosen = np.unique(cell, return_index=True)
    cell, chosen = cell[cell >= 0], chosen[cell >= 0]
    q, azimuth, centers = q[chosen], azimuth[chosen], np.empty((len(chosen), len(radius_m), 3), np.float16)
    for some in _slices(len(q)):
        seen = np.moveaxis(frame_poses(tree, q[some])[:, :-1, :3, 3], 2, 0)  # (3, M, B)
        seen[:2] -= arm.axis_xy_m[:, None, None]
        centers[some] = np.moveaxis(to_front(azimuth[some, None], seen), 0, 2)
    way = tree.hand_joints()
    depth = np.zeros(len(tree.parent))
    depth[way[::-1]] = np.arange(1, 1 + len(way)) / len(way)
    upright = int(tree.coordinate[next((j for j in way[::-1] if not tree.slides[j]), way[0])])
    limits = np.array([tree.lower[upright], tree.upper[upright]] if arm.turns else [-np.inf, np.inf])
    turn_rad, along = q[:, upright] - azimuth, depth[tree.frame_joint[:-1]]
    return ArmLinks(cell, wrist_m[chosen], turn_rad, centers, radius_m, along, limits, np.array(arm.half_m))


def cells_at(arm: PoseReach, distance_m: F64, height_m: F64, direction: Ints) -> Ints:
    """Cells (...) of a map; -1 outside of it. `direction` is that of `cells_of`."""
    i = np.floor(distance_m / arm.half_m * DISTANCES).astype(np.int64)
    k = np.floor((height_m / arm.half_m + 1) / 2 * HEIGHTS).astype(np.int64)
    inside = (i >= 0) & (i < DISTANCES) & (k >= 0) & (k < HEIGHTS)
    per_height = CELLS * (1 if arm.turns else AZIMUTHS)
    return np.where(inside, direction + (i * HEIGHTS + k) * per_height, -1)


def to_front(azimuth: F64, v: F64) -> F64:
    """Vectors (3, ...) turned by -azimuth (...) about z."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    return np.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], v[2] + 0 * c])


def _slices(count: int) -> list[slice]:
    return [slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE)]


def spheres_along(points_m: F32) -> tuple[F64, float]:
    """Centres (n, 3) and radius of at most five spheres along the longest side of a link's points (V, 3)."""
    middle = points_m.astype(np.float64).mean(axis=0)
    away = points_m - middle
    axes = np.linalg.eigh(away.T @ away)[1]
    local = away @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    short, thick, longest = np.argsort(high - low, kind="stable")
    radius_m = max(0.225 * float((high - low)[[short, thick]].sum()), _LEAST_RADIUS_M)
    count = int(np.clip(np.ceil((high - low)[longest] / (1.6 * radius_m)), 1, _MOST_SPHERES))
    centers = np.tile((low + high) / 2, (count, 1))
    if count > 1:
        centers[:, longest] = np.linspace(low[longest] + radius_m, high[longest] - radius_m, count)
    return middle + centers @ axes.T, radius_m
