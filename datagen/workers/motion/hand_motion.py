"""What the hand alone can do around the target, compiled: approach a grasp, and lift."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled, constant, struct
from datagen.workers.kinematics.contacts import Parts, Scratch, Still, hits_still, scratch_of
from datagen.workers.kinematics.tree import Bools, Ints

# Kinds of still parts, as bits.
NOTHING, TARGET, FLOOR, OTHER = constant(0), constant(1), constant(2), constant(4)
_ALL_BUT_TARGET = ~TARGET


class Hand(NamedTuple):
    """The hand in the TCP frame, one shape an opening; the last is fully open."""

    whole: Parts
    core: Parts  # what lies 2 mm inside the parts


struct(Hand)


class Poses(NamedTuple):
    """K poses of the hand at the target; states are 1, -1, or 0 where not known yet, and are filled in."""

    T_world_tcp: F64  # (K, 3, 4)
    opening: Ints  # (K,), row of the hand's openings
    clears: npt.NDArray[np.int8]  # (K,), the hand clears the target on its approach
    is_free: npt.NDArray[np.int8]  # (K,), and everything else, and can lift the target
    allowed: Bools  # (K,), those that may be tried

    @staticmethod
    def unknown(T_world_tcp: F64, opening: Ints) -> Poses:
        """Poses of which nothing is known yet."""
        n = len(opening)
        return Poses(T_world_tcp, opening, np.zeros(n, np.int8), np.zeros(n, np.int8), np.ones(n, np.bool_))


struct(Poses)


class Limits(NamedTuple):
    """Parameters of the search."""

    seeds: int
    pregrasp_m: float
    lift_m: float
    line_step_m: float
    jump: float
    step: float
    margin_m: float
    hand_margin_m: float
    slack_m: float


struct(Limits)


class Room(NamedTuple):
    """The scene around the target."""

    still: Still
    near_target: Ints  # parts that the hand can touch while it grasps and lifts


struct(Room)


class HandWork(NamedTuple):
    """Arrays that checks of the hand write into."""

    frame: F64  # (1, 3, 4), the TCP
    whole: Scratch
    core: Scratch


new_hand_work = struct(HandWork)


@compiled
def hand_workspace(parts: int, still: int) -> HandWork:
    """Arrays for checks of a hand, by the number of its parts and of still parts."""
    return new_hand_work(np.empty((1, 3, 4)), scratch_of(parts, still), scratch_of(parts, still))


@compiled
def points_on(length_m: float, step_m: float) -> int:
    """How many points lie on a line, both ends included, at most `step_m` apart."""
    return 1 + math.ceil(length_m / step_m - 1e-9)


@compiled
def moved(T: F64, back_m: float, rise_m: float, out: F64) -> None:
    """The pose (3, 4) drawn back along its approach and raised in the world."""
    for i in range(3):
        for k in range(4):
            out[i, k] = T[i, k]
        out[i, 3] -= T[i, 2] * back_m
    out[2, 3] += rise_m


@compiled
def _clears_target(hand: Hand, room: Room, limits: Limits, T: F64, opening: int, w: HandWork) -> bool:
    """Whether the hand clears the target along its approach; its core may not touch, its skin may."""
    still, rows, at = room.still, room.near_target, w.frame
    n = points_on(limits.pregrasp_m, limits.line_step_m)
    for k in range(n):
        is_skin = k == 0  # at the pregrasp, which is reached by joints, nothing touches
        parts, s = (hand.whole, w.whole) if is_skin else (hand.core, w.core)
        margin_m = limits.margin_m + limits.slack_m if is_skin else 0.0
        moved(T, limits.pregrasp_m if is_skin else limits.pregrasp_m * (k - 1) / (n - 1), 0.0, at[0])
        if hits_still(parts, opening, at, still, rows, _ALL_BUT_TARGET, margin_m, s):
            return False
    return True


@compiled
def _clears_rest(hand: Hand, room: Room, limits: Limits, T: F64, opening: int, w: HandWork) -> bool:
    """Whether the hand clears all but the target along its approach and while it lifts."""
    still, rows, at = room.still, room.near_target, w.frame
    back = points_on(limits.pregrasp_m, limits.line_step_m)
    rise = points_on(limits.lift_m, limits.line_step_m)
    for k in range(back + rise - 1):
        # The grasp, the approach from its far end, then the lift.
        margin_m = limits.margin_m + limits.slack_m if k == 1 else limits.hand_margin_m
        back_m = limits.pregrasp_m * (back - k) / (back - 1) if 0 < k < back else 0.0
        rise_m = limits.lift_m * (k + 1 - back) / (rise - 1) if k >= back else 0.0
        moved(T, back_m, rise_m, at[0])
        if hits_still(hand.whole, opening, at, still, rows, TARGET, margin_m, w.whole):
            return False
    return True


@compiled
def is_hand_free(hand: Hand, room: Room, limits: Limits, poses: Poses, k: int, w: HandWork) -> bool:
    """Whether the hand clears everything on its way to pose `k` and while it lifts; computed on first use."""
    T, opening = poses.T_world_tcp[k], poses.opening[k]
    if poses.clears[k] == 0:
        poses.clears[k] = 1 if _clears_target(hand, room, limits, T, opening, w) else -1
    if poses.clears[k] > 0 and poses.is_free[k] == 0:
        poses.is_free[k] = 1 if _clears_rest(hand, room, limits, T, opening, w) else -1
    return poses.clears[k] > 0 and poses.is_free[k] > 0


@compiled
def clear_poses(hand: Hand, room: Room, limits: Limits, T: F64, opening: Ints) -> Bools:
    """Whether the hand at poses (K, 3, 4) clears the target (K,)."""
    w, out = hand_workspace(len(hand.whole.owner), len(room.still.kind)), np.empty(len(T), np.bool_)
    for k in range(len(T)):
        out[k] = _clears_target(hand, room, limits, T[k], opening[k], w)
    return out


@compiled
def free_poses(hand: Hand, room: Room, limits: Limits, poses: Poses, first: int, end: int) -> int:
    """Check the poses from `first` to `end` in the scene; how many of them are free."""
    w, total = hand_workspace(len(hand.whole.owner), len(room.still.kind)), 0
    for k in range(first, end):
        total += is_hand_free(hand, room, limits, poses, k, w)
    return total
