"""What the arm can do from one base pose, compiled: configurations and lines that are free."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled, constant, struct
from datagen.workers.kinematics.contacts import (
    Parts,
    Scratch,
    hits_itself,
    hits_still,
    own_scratch,
    scratch_of,
)
from datagen.workers.kinematics.inverse import (
    IkWork,
    frame_poses,
    ik_workspace,
    joint_poses,
    put,
    solve,
    tcp_pose,
)
from datagen.workers.kinematics.tree import Ints, KinematicTree
from datagen.workers.motion.hand_motion import (
    FLOOR,
    NOTHING,
    Hand,
    HandWork,
    Limits,
    Room,
    hand_workspace,
    moved,
)
from datagen.workers.motion.reach_map import ReachMap, ReachWork, reach_workspace

NO_HAND = constant(-1)  # an opening: the arm alone
ONE_SHAPE, NO_HOME = constant(0), constant(-1)
_FIRST_LOOK = 8  # stride of the first, coarse check of a long line
_OFF_LINE_M = 0.002  # between neighbouring points, where coordinates are interpolated


class Arm(NamedTuple):
    """A robot as the planner sees it. Owners of parts are frames of the tree; one more is the base."""

    tree: KinematicTree
    body: Parts  # links that joints move, without the hand
    fixed: Parts  # links that no joint moves
    own: Parts  # links, fingers and pedestal, for contacts of the robot with itself
    own_pairs: Ints  # (K, 2), parts of `own` that must not touch
    homes: F64  # (H, A)
    weight: F64  # (A,), radians that a unit of each coordinate counts as
    reach: ReachMap


struct(Arm)


class Work(NamedTuple):
    """Arrays that a search writes into, and the lines that it found."""

    joints: F64  # (J, 3, 4)
    frames: F64  # (F + 1, 3, 4), the last is the base
    ik: IkWork
    reach: ReachWork
    body: Scratch
    hand: HandWork
    own: Scratch
    own_axes: F64  # (K, 3)
    homes: npt.NDArray[np.int8]  # (H,), 1 where the tucked pose is free, -1 where not, 0 not known
    # Lines of grasps: `without_path` of them have no straight path; the next row is that of the pose in work.
    back: F64  # (S + 1, B, A), grasp to pregrasp
    lift: F64  # (S + 1, L, A)
    without_path: Ints  # (1,), at most S = 4


new_work = struct(Work)


class Search(NamedTuple):
    """One robot at one base pose in one scene: what every check of a plan needs."""

    arm: Arm
    hand: Hand
    room: Room
    limits: Limits
    T_root: F64  # (3, 4), world
    rows: Ints  # still parts within the arm's reach
    is_stuck: bool  # the robot collides without its arm
    work: Work


_new_search = struct(Search)


@compiled
def search_at(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    T_root: F64,
    rows: Ints,
    back: F64,
    lift: F64,
    without_path: Ints,
) -> Search:
    """The search at a base pose; its arrays are new, so that no result depends on earlier ones."""
    still, count = len(room.still.kind), len(arm.weight)
    work = new_work(
        np.empty((len(arm.tree.parent), 3, 4)),
        np.empty((len(arm.tree.frame_joint) + 1, 3, 4)),
        ik_workspace(arm.tree),
        reach_workspace(count),
        scratch_of(len(arm.body.owner), still),
        hand_workspace(len(hand.whole.owner), still),
        own_scratch(arm.own),
        np.zeros((len(arm.own_pairs), 3)),
        np.zeros(len(arm.homes), np.int8),
        back,
        lift,
        without_path,
    )
    frame_poses(arm.tree, T_root, work.joints, work.frames)
    scratch = scratch_of(len(arm.fixed.owner), still)
    # Links that no joint moves may touch nothing but the floor.
    is_stuck = hits_still(arm.fixed, ONE_SHAPE, work.frames, room.still, rows, FLOOR, 0.0, scratch)
    return _new_search(arm, hand, room, limits, T_root, rows, is_stuck, work)


@compiled
def pose_arm(s: Search, q: F64) -> None:
    """Set the frames of the work to those at the coordinates (A,)."""
    w, tree = s.work, s.arm.tree
    joint_poses(tree, s.T_root, q, w.joints)
    frame_poses(tree, s.T_root, w.joints, w.frames)
    put(s.T_root, w.frames[-1])


@compiled
def is_blocked(s: Search, q: F64, opening: int, ignored: int) -> bool:
    """Whether the arm, and with an opening of 0 or more the hand, collides at the coordinates (A,)."""
    arm, still, rows, margin_m, w = s.arm, s.room.still, s.rows, s.limits.margin_m, s.work
    pose_arm(s, q)
    if hits_still(arm.body, ONE_SHAPE, w.frames, still, rows, ignored, margin_m, w.body):
        return True
    if opening >= 0:
        put(w.frames[-2], w.hand.frame[0])
        if hits_still(s.hand.whole, opening, w.hand.frame, still, rows, ignored, margin_m, w.hand.whole):
            return True
    return hits_itself(arm.own, arm.own_pairs, w.frames, w.own_axes, w.own)


@compiled
def length(weight: F64, a: F64, b: F64) -> float:
    """Distance of two rows of coordinates (A,), radians."""
    total = 0.0
    for m in range(len(a)):
        total += ((b[m] - a[m]) * weight[m]) ** 2
    return math.sqrt(total)


@compiled
def steps_on(weight: F64, a: F64, b: F64, step: float) -> int:
    """How many steps of at most `step` radians lie on a line."""
    return max(1, math.ceil(length(weight, a, b) / step - 1e-9))


@compiled
def between(a: F64, b: F64, k: int, n: int, out: F64) -> None:
    """Point k of n on the straight line; the last is b to the bit, so that lines join."""
    for m in range(len(a)):
        out[m] = b[m] if k == n else a[m] + k / n * (b[m] - a[m])


@compiled
def is_line_free(s: Search, a: F64, b: F64, opening: int, ignored: int) -> bool:
    """Whether nothing on the straight line after `a` collides; looks at a sparse subset first."""
    n, q = steps_on(s.arm.weight, a, b, s.limits.step), np.empty(len(a))
    is_sparse = n > 2 * _FIRST_LOOK
    for look in range(2 if is_sparse else 1):
        for k in range(1, n + 1):
            if is_sparse and ((k - 1) % _FIRST_LOOK == _FIRST_LOOK // 2) != (look == 0):
                continue
            between(a, b, k, n, q)
            if is_blocked(s, q, opening, ignored):
                return False
    return True


@compiled
def follow(s: Search, T: F64, back_m: float, rise_m: float, ignored: int, out: F64) -> bool:
    """Coordinates (n, A) along a straight line of the hand from the grasp (3, 4); whether all is free.

    Rows `out[0]` and, on the way back, `out[-1]` are given. It fails where a pose has no solution, a
    coordinate jumps, the hand leaves the line by more than 2 mm in between, or the arm collides. The hand's
    own line is known to be free.
    """
    n, count = len(out), out.shape[1]
    tree, weight, w, jump, is_end_known = s.arm.tree, s.arm.weight, s.work, s.limits.jump, back_m > 0
    goal, before, at, middle = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4)), np.empty(count)
    moved(T, 0.0, 0.0, before)
    for k in range(1, n):
        moved(T, back_m * k / (n - 1), rise_m * k / (n - 1), goal)
        if not is_end_known or k < n - 1:
            for m in range(count):
                # The seed: a step towards the known end, or the last step again.
                if is_end_known:
                    step = (out[n - 1, m] - out[k - 1, m]) / (n - k)
                else:
                    step = out[k - 1, m] - out[max(k - 2, 0), m]
                out[k, m] = out[k - 1, m] + step
            if not solve(tree, s.T_root, goal, out[k], w.ik):
                return False
        for m in range(count):
            if abs(out[k, m] - out[k - 1, m]) * weight[m] > jump:
                return False
            middle[m] = (out[k, m] + out[k - 1, m]) / 2
        joint_poses(tree, s.T_root, middle, w.joints)
        tcp_pose(tree, s.T_root, w.joints, at)
        off = 0.0
        for i in range(3):
            off += (at[i, 3] - (goal[i, 3] + before[i, 3]) / 2) ** 2
        if off > _OFF_LINE_M**2:
            return False
        put(goal, before)
    if is_blocked(s, out[0], NO_HAND, ignored):
        return False
    for k in range(1, n):
        if not is_line_free(s, out[k - 1], out[k], NO_HAND, ignored):
            return False
    return True


@compiled
def has_free_home(s: Search) -> bool:
    """Whether any tucked pose is free, with the hand fully open."""
    homes, states, parts, is_any = s.arm.homes, s.work.homes, s.hand.whole, False
    fully_open = len(parts.center_m) // len(parts.owner) - 1
    for h in range(len(homes)):
        if states[h] == 0:
            states[h] = -1 if is_blocked(s, homes[h], fully_open, NOTHING) else 1
        is_any |= states[h] > 0
    return is_any


@compiled
def next_home(s: Search, q: F64, after: int) -> int:
    """The free tucked pose nearest to the coordinates (A,), or the next one `after` another; -1: none."""
    found, homes, weight = NO_HOME, s.arm.homes, s.arm.weight
    passed = 0.0 if after < 0 else length(weight, homes[after], q)
    least = np.inf
    for h in range(len(homes)):
        if s.work.homes[h] > 0:
            far = length(weight, homes[h], q)
            if far < least and (after < 0 or far > passed or (far == passed and h > after)):
                found, least = h, far
    return found
