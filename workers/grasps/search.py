"""Search grasps of one object by one gripper: collision-free poses, of which a varied set is scored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import QhullError

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.grasps.contacts import cone_directions, contact_pairs, solid_of, surface_points
from datagen.workers.grasps.floating_hand import HandTest, held_trials
from datagen.workers.grasps.hand_clearance import HandClearance, lowest_m
from datagen.workers.grasps.hand_poses import flipped, hand_poses, varied
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper

Bools = npt.NDArray[np.bool_]

# Part of every cache key and seed: raise it when the same object and hand get other grasps.
VERSION = 2
# Room between the open fingers and the object, both sides together: the first that lets the hand in.
AIR_M = (0.02, 0.006)
_LEAST_AIR_M = 0.004
# The hand stays this far above what an upright object stands on.
TABLE_GAP_M = 0.002
_ROUNDS, _POINTS = 3, 800  # and points drawn on the surface in each
_MORE_ROUNDS, _FEW_CLEAR = 10, 60  # where hardly a pose keeps above the table
_CLEAR_POSES, _OTHER_POSES = 1500, 1000  # checked against the object in each round
_ENOUGH_FREE, _ENOUGH_CLEAR = 800, 300
# Physics takes longest with many parts. With its flip every scored grasp counts twice.
_SCORED, _SCORED_OF_MANY_PARTS, _MANY_PARTS = 64, 40, 16
_SHARE_CLEAR = 0.75  # of what is scored, where there are enough


@dataclass(frozen=True, eq=False)
class ScoredGrasps:
    """G grasps of one object, best first. None where `reason` says why."""

    T_object_tcp: F64  # (G, 4, 4)
    opening_m: F32  # (G,)
    score: F32  # (G,), share of floating-hand trials that held
    is_clear: Bools  # (G,), the hand stays above the plane that the upright object stands on
    n_tried: int  # poses checked against the object
    n_free: int  # those in which the hand touches nothing of it
    n_clear: int  # and stays above that plane
    reason: str

    def __len__(self) -> int:
        return len(self.score)


def search_grasps(
    model: ObjectModel, gripper: Gripper, per_object: int, rng: np.random.Generator
) -> ScoredGrasps:
    """At most `per_object` grasps, spread over the object, with their scores.

    An object that cannot be grasped gives none and a reason, and so does one whose parts have no
    volume.
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
    n_free, n_clear = len(T), int(is_clear.sum())
    chosen = _choose(T, is_clear, _n_scored(model, per_object))
    T, opening_m, is_clear = T[chosen], opening_m[chosen], is_clear[chosen]
    held = held_trials(model.convex_parts_m, model.mass_kg, gripper, T, opening_m, rng, HandTest())
    score = held.mean(axis=1)
    # The flip presses the same pads on the same places: its score is the same.
    turned = flipped(T)
    fits = HandClearance(model.convex_parts_m, gripper).free(turned, opening_m)
    row = np.concatenate([np.arange(len(T)), np.flatnonzero(fits)])
    poses = np.concatenate([T, turned[fits]])
    order = np.lexsort((np.arange(len(row)) >= len(T), row, -score[row]))[:per_object]
    row = row[order]
    reason = "" if score.any() else "no grasp holds the object"
    return ScoredGrasps(
        poses[order],
        opening_m[row].astype(np.float32),
        score[row].astype(np.float32),
        is_clear[row],
        n_tried,
        n_free,
        n_clear,
        reason,
    )


def _free_poses(model: ObjectModel, gripper: Gripper, rng: np.random.Generator) -> tuple[F64, F64, int]:
    """Poses (N, 4, 4) and openings (N,) that keep the hand free of the object, and how many were tried."""
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
        # Few poses around a flat thing keep above the table: those are looked at first.
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
    """In which poses (N, 4, 4) the hand stays above what the upright object stands on."""
    return lowest_m(gripper, T_object_tcp, opening_m) > TABLE_GAP_M - model.size_m[2] / 2


def _n_scored(model: ObjectModel, per_object: int) -> int:
    few = len(model.convex_parts_m) <= _MANY_PARTS
    return min((per_object + 1) // 2, _SCORED if few else _SCORED_OF_MANY_PARTS)


def _choose(T_object_tcp: F64, is_clear: Bools, n: int) -> npt.NDArray[np.int64]:
    """Rows of at most n varied poses, most of them clear of the table where there are such."""
    clear, other = np.flatnonzero(is_clear), np.flatnonzero(~is_clear)
    n_clear = min(len(clear), max(round(n * _SHARE_CLEAR), n - len(other)))
    n_other = min(len(other), n - n_clear)
    return np.concatenate(
        [clear[varied(T_object_tcp[clear], n_clear)], other[varied(T_object_tcp[other], n_other)]]
    )


def _none(n_tried: int, reason: str) -> ScoredGrasps:
    return ScoredGrasps(
        np.zeros((0, 4, 4)),
        np.zeros(0, np.float32),
        np.zeros(0, np.float32),
        np.zeros(0, bool),
        n_tried,
        0,
        0,
        reason,
    )
