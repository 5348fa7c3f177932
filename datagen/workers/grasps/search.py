"""Search grasps of one object by one gripper: collision-free poses, in a varied order, and their scores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import QhullError

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.grasps.contacts import cone_directions, contact_pairs, solid_of, surface_points
from datagen.workers.grasps.floating_hand import HandTest, held_trials
from datagen.workers.grasps.hand_clearance import HandClearance, lowest_m
from datagen.workers.grasps.hand_poses import hand_poses, varied
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper

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
    """N poses in which the hand does not touch the object. The first n, for any n, are spread over it.

    Where N is 0, `reason` is the cause.
    """

    T_object_tcp: F64  # (N, 4, 4)
    opening_m: F64  # (N,)
    is_clear: Bools  # (N,), the hand stays above the plane that the upright object stands on
    n_tried: int  # poses checked against the object
    reason: str

    def __len__(self) -> int:
        return len(self.opening_m)


def hand_poses_of(model: ObjectModel, gripper: Gripper, rng: np.random.Generator) -> HandPoses:
    """All hand poses around an object that one search finds: a few hundred to two thousand.

    An object that cannot be grasped, or whose parts have no volume, gives no poses and a reason.
    """
    if not model.convex_parts_m or not all(np.isfinite(part).all() for part in model.convex_parts_m):
        return _none(0, "no collision parts, or a corner that is not finite")
    try:
        T, opening_m, n_tried = _free_poses(model, gripper, rng)
    except QhullError:
        return _none(0, "a collision part has no volume")
    if n_tried == 0:
        return _none(0, "no two opposite sides are near enough for the fingers")
    if len(T) == 0:
        return _none(n_tried, "the hand touches the object in every pose")
    is_clear = _is_clear(model, gripper, T, opening_m)
    order = _spread(T, is_clear)
    return HandPoses(T[order], opening_m[order], is_clear[order], n_tried, "")


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


def _free_poses(model: ObjectModel, gripper: Gripper, rng: np.random.Generator) -> tuple[F64, F64, int]:
    """Poses (N, 4, 4) and openings (N,) with the hand free of the object, and the number of poses tried."""
    solid = solid_of(model.convex_parts_m)
    hand = HandClearance(model.convex_parts_m, gripper)
    poses: list[F64] = [np.zeros((0, 4, 4))]
    openings: list[F64] = [np.zeros(0)]
    n_tried = n_clear = 0
    for number in range(1, _MORE_ROUNDS + 1):
        points_m, normals = surface_points(solid, _POINTS, rng)
        pairs = contact_pairs(
            solid, points_m, cone_directions(normals, rng), gripper.max_opening_m - _LEAST_AIR_M
        )
        T, width_m = hand_poses(pairs, gripper.pad_size_m[1], rng)
        # Few poses around a flat object are clear of the table: these are checked first.
        clear = _is_clear(model, gripper, T, np.minimum(width_m + AIR_M[0], gripper.max_opening_m))
        rows = np.concatenate([np.flatnonzero(clear)[:_CLEAR_POSES], np.flatnonzero(~clear)[:_OTHER_POSES]])
        T, width_m = T[rows], width_m[rows]
        n_tried += len(T)
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
    return np.concatenate(poses), np.concatenate(openings), n_tried


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


def _none(n_tried: int, reason: str) -> HandPoses:
    return HandPoses(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0, bool), n_tried, reason)
