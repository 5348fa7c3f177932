"""Search grasps of an object by a gripper: poses around contacts, in a varied order, and their scores."""

# coal defines its names at import time, which type checkers do not see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import numpy.typing as npt
from scipy.spatial import QhullError

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.grasps.contacts import (
    Contacts,
    cone_directions,
    contact_pairs,
    perpendicular,
    solid_of,
    surface_points,
)
from datagen.workers.grasps.floating_hand import HandTest, held_trials
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper
from datagen.workers.robots.hulls import polyhedron

Bools = npt.NDArray[np.bool_]

# Part of every cache key and seed: raise it when the same object and hand get other grasps.
VERSION = 4
# Poses that are scored together: a score depends on the poses of its block, which are always the same.
BLOCK = 32
# Gaps between the open fingers and the object, both sides together; the first that the hand fits in counts.
AIR_M = (0.02, 0.006)
_LEAST_AIR_M = 0.004
# The hand stays this far above the plane that the upright object stands on.
TABLE_GAP_M = 0.002
_ROUNDS, _POINTS = 3, 800  # rounds, and points sampled on the surface in each
_MORE_ROUNDS, _FEW_CLEAR = 10, 60  # rounds while fewer poses than this are clear of the table
_CLEAR_POSES, _OTHER_POSES = 1500, 1000  # checked against the object in each round
_ENOUGH_FREE, _ENOUGH_CLEAR = 800, 300
_CLEAR_IN_FOUR = 3  # clear poses among four in a row, where there are enough of both kinds


@dataclass(frozen=True, eq=False)
class HandPoses:
    """N poses in which the hand does not touch the object. The first n, for any n, are spread over it."""

    T_object_tcp: F64  # (N, 4, 4)
    opening_m: F64  # (N,)
    is_clear: Bools  # (N,), the hand stays above the plane that the upright object stands on

    def __len__(self) -> int:
        return len(self.opening_m)


def hand_poses_of(model: ObjectModel, gripper: Gripper, rng: np.random.Generator) -> HandPoses:
    """All hand poses around an object that one search finds: a few hundred to two thousand.

    An object that cannot be grasped, or whose parts have no volume, gives no poses.
    """
    parts = model.convex_parts_m
    T, opening_m = np.zeros((0, 4, 4)), np.zeros(0)
    if parts and all(np.isfinite(part).all() for part in parts):
        with suppress(QhullError):  # a part without volume
            T, opening_m = _free_poses(model, gripper, rng)
    is_clear = _is_clear(model, gripper, T, opening_m)
    order = _spread(T, is_clear)
    return HandPoses(T[order], opening_m[order], is_clear[order])


def score_block(
    model: ObjectModel, gripper: Gripper, poses: HandPoses, block: int, rng: np.random.Generator
) -> F32:
    """Shares (n,) of the pulls that the poses of one block hold, n <= `BLOCK`."""
    rows = slice(block * BLOCK, (block + 1) * BLOCK)
    return score_poses(model, gripper, poses.T_object_tcp[rows], poses.opening_m[rows], rng)


def score_poses(
    model: ObjectModel, gripper: Gripper, T_object_tcp: F64, opening_m: F64, rng: np.random.Generator
) -> F32:
    """Shares (n,) of the pulls that the hand holds at poses (n, 4, 4) with openings (n,)."""
    held = held_trials(model.convex_parts_m, model.mass_kg, gripper, T_object_tcp, opening_m, rng, HandTest())
    return held.mean(axis=1).astype(np.float32)


def _free_poses(model: ObjectModel, gripper: Gripper, rng: np.random.Generator) -> tuple[F64, F64]:
    """Poses (N, 4, 4) and openings (N,) with the hand free of the object."""
    solid = solid_of(model.convex_parts_m)
    hand = HandClearance(model.convex_parts_m, gripper)
    poses: list[F64] = [np.zeros((0, 4, 4))]
    openings: list[F64] = [np.zeros(0)]
    n_clear = 0
    for number in range(1, _MORE_ROUNDS + 1):
        points_m, normals = surface_points(solid, _POINTS, rng)
        pairs = contact_pairs(
            solid, points_m, cone_directions(normals, rng), gripper.max_opening_m - _LEAST_AIR_M
        )
        T, width_m = hand_poses(pairs, gripper.pad_size_m[1], rng)
        if gripper.linkage is not None:  # fingers that turn move their pads along the approach
            T[:, :3, 3] -= gripper.pad_depth_m(width_m)[:, None] * T[:, :3, 2]
        is_wide = width_m >= gripper.least_width_m
        T, width_m = T[is_wide], width_m[is_wide]
        # Few poses around a flat object are clear of the table: these are checked first.
        clear = _is_clear(model, gripper, T, np.minimum(width_m + AIR_M[0], gripper.max_opening_m))
        rows = np.concatenate([np.flatnonzero(clear)[:_CLEAR_POSES], np.flatnonzero(~clear)[:_OTHER_POSES]])
        T, width_m = T[rows], width_m[rows]
        for air_m in AIR_M:
            opening_m = np.minimum(width_m + air_m, gripper.max_opening_m)
            free = hand.free(T, opening_m)
            poses.append(T[free])
            openings.append(opening_m[free])
            n_clear += int(_is_clear(model, gripper, T[free], opening_m[free]).sum())
            T, width_m = T[~free], width_m[~free]
        enough = n_clear >= _ENOUGH_CLEAR and sum(map(len, poses)) >= _ENOUGH_FREE
        if enough or (number >= _ROUNDS and n_clear >= _FEW_CLEAR):
            break
    return np.concatenate(poses), np.concatenate(openings)


def _is_clear(model: ObjectModel, gripper: Gripper, T_object_tcp: F64, opening_m: F64) -> Bools:
    """Whether the hand at each pose (N, 4, 4) stays above the plane that the upright object stands on."""
    return lowest_m(gripper, T_object_tcp, opening_m) > TABLE_GAP_M - model.size_m[2] / 2


def _spread(T_object_tcp: F64, is_clear: Bools) -> npt.NDArray[np.int64]:
    """An order (N,) of all poses: the first n, for any n, are varied and mostly clear of the table."""
    clear, other = np.flatnonzero(is_clear), np.flatnonzero(~is_clear)
    clear = clear[varied(T_object_tcp[clear], len(clear))]
    other = other[varied(T_object_tcp[other], len(other))]
    # Interleave the two kinds; the rest of the longer one comes last.
    rank = np.concatenate(
        [np.arange(len(clear)) / _CLEAR_IN_FOUR, np.arange(len(other)) / (4 - _CLEAR_IN_FOUR) + 0.5]
    )
    return np.concatenate([clear, other])[np.argsort(rank, kind="stable")]


# How far the contacts lie ahead of the pads' middle, in half pad lengths. Pulled back, the finger tips do not
# reach below flat objects. Beyond 1 the pads would miss the contacts.
RETREATS = (-0.5, 0.0, 0.5, 0.8, 0.95)
# From straight down, about the axis along which the fingers close.
TILTS_RAD = (0.0, np.radians(15), np.radians(-15), np.radians(30), np.radians(-30))
# Grasps from above need a closing axis no steeper than this.
_LEVEL_Z = np.sin(np.radians(35))
_FREE_TURNS = 4  # approaches all around the closing axis, besides those from above
# A radian between two directions weighs as much as this distance.
_METRES_PER_RAD = 0.03


def hand_poses(contacts: Contacts, pad_length_m: float, rng: np.random.Generator) -> tuple[F64, F64]:
    """Poses T_object_tcp (K, 4, 4) of every pair, approach and depth in random order; widths (K,), metres.

    Approaches are drawn all around the closing axis and, where it is level enough for the upright object,
    from above with `TILTS_RAD`. The contacts lie on pads of `pad_length_m` along the approach, at the same
    distance left and right of the hand's middle, at one of `RETREATS`.
    """
    n = len(contacts)
    y = contacts.closing * np.where(rng.random(n) < 0.5, 1.0, -1.0)[:, None]
    u, v = perpendicular(y)
    turns = 2 * np.pi * rng.random((n, _FREE_TURNS))
    around = np.cos(turns)[..., None] * u[:, None] + np.sin(turns)[..., None] * v[:, None]
    level = np.abs(y[:, 2]) < _LEVEL_Z
    down = -np.array([0.0, 0.0, 1.0]) + y[level, 2:] * y[level]
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    across = np.cross(y[level], down)
    tilts = np.array(TILTS_RAD)
    above = np.cos(tilts)[:, None] * down[:, None] + np.sin(tilts)[:, None] * across[:, None]
    row = np.concatenate(
        [np.repeat(np.arange(n), _FREE_TURNS), np.repeat(np.flatnonzero(level), len(TILTS_RAD))]
    )
    approach = np.concatenate([around.reshape(-1, 3), above.reshape(-1, 3)])
    row = np.repeat(row, len(RETREATS))
    approach = np.repeat(approach, len(RETREATS), axis=0)
    retreat = pad_length_m / 2 * np.resize(RETREATS, len(row))
    order = rng.permutation(len(row))
    row, approach, retreat = row[order], approach[order], retreat[order]
    middle = (contacts.first_m + contacts.second_m) / 2
    T = np.zeros((len(row), 4, 4))
    T[:, :3, 0] = np.cross(y[row], approach)
    T[:, :3, 1] = y[row]
    T[:, :3, 2] = approach
    T[:, :3, 3] = middle[row] - retreat[:, None] * approach
    T[:, 3, 3] = 1
    return T, contacts.width_m[row]


def varied(T_object_tcp: F64, n: int) -> npt.NDArray[np.int64]:
    """Rows of at most n poses by farthest-point sampling, from the first pose on.

    The distance adds those of positions and of directions of approach and closing; a grasp and its flip
    count as one (Gonzalez 1985, Theor. Comput. Sci. 38).
    """
    if len(T_object_tcp) == 0 or n < 1:
        return np.zeros(0, np.int64)
    y, z = T_object_tcp[:, :3, 1], T_object_tcp[:, :3, 2]
    position = np.ascontiguousarray(T_object_tcp[:, :3, 3].T)  # (3, N): sums over a long last axis are fast
    gap = np.full(len(y), np.inf)
    rows = [0]
    while len(rows) < min(n, len(y)):
        k = rows[-1]
        apart = np.sqrt(np.square(position - position[:, k : k + 1]).sum(axis=0))
        turned = np.arccos(np.clip(z @ z[k], -1, 1)) + np.arccos(np.clip(np.abs(y @ y[k]), 0, 1))
        gap = np.minimum(gap, apart + _METRES_PER_RAD * turned)
        gap[k] = -1.0
        rows.append(int(gap.argmax()))
    return np.array(rows)


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
        self._gripper = gripper
        self._hands: dict[int, list[tuple[Any, float]]] = {}

    def _hand(self, posture: int) -> list[tuple[Any, float]]:
        """The swept parts of the hand near a measured opening; the palm first: it collides most often."""
        if posture not in self._hands:
            left, right = self._gripper.fingers_in[posture]
            self._hands[posture] = [
                (coal.CollisionObject(polyhedron(swept(part))), side)
                for parts, side in ((self._gripper.palm_parts_m, 0.0), (left, 0.5), (right, -0.5))
                for part in parts
            ]
        return self._hands[posture]

    def free(self, T_object_tcp: F64, opening_m: F64 | F32) -> Bools:
        """Whether the hand, its approach included, is free of the object at each pose (N, 4, 4); (N,)."""
        postures = self._gripper.posture(np.asarray(opening_m, np.float64)).tolist()
        rows = zip(T_object_tcp, opening_m, postures, strict=True)
        return np.array([self._is_free(T, float(o), posture) for T, o, posture in rows], bool)

    def _is_free(self, T: F64, opening_m: float, posture: int) -> bool:
        R, p, y = T[:3, :3], T[:3, 3], T[:3, 1]
        callback = coal.CollisionCallBackDefault()
        for part, side in self._hand(posture):
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
    opening_m = np.asarray(opening_m, np.float64)
    lowest, posture = np.full(len(down), np.inf), gripper.posture(opening_m)
    for k in np.unique(posture):
        rows = np.flatnonzero(posture == k)
        left, right = gripper.fingers_in[k]
        for parts, side in ((left, 0.5), (right, -0.5), (gripper.palm_parts_m, 0.0)):
            shift = side * opening_m[rows] * down[rows, 1]
            for part in parts:
                low = (down[rows] @ swept(part).T.astype(np.float64)).min(axis=1) + shift
                lowest[rows] = np.minimum(lowest[rows], low)
    return lowest + T_object_tcp[:, 2, 3]
