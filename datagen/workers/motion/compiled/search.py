"""Search for a whole plan from one base pose, compiled: hand, inverse kinematics, lines, paths.

The same checks in the same order for every candidate; all random numbers come from the generator given.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.compiled.compiler import compiled, struct
from datagen.workers.motion.compiled.contacts import (
    Parts,
    Scratch,
    Still,
    hits_itself,
    hits_still,
    radii_m,
    scratch_of,
    smallest_gap_m,
)
from datagen.workers.motion.compiled.kinematics import (
    IkWork,
    frame_poses,
    ik_workspace,
    joint_poses,
    solve,
    tcp_pose,
)
from datagen.workers.motion.compiled.reach_map import ReachMap, score, seeds
from datagen.workers.robots.kinematic_tree import Bools, Ints, KinematicTree

TARGET, FLOOR = 1, 2  # kinds of still parts
NO_IK, ARM_COLLISION, NO_START, NO_APPROACH, NO_LIFT, NO_PATH, SUCCESS = range(7)
_STARTS = 3  # tucked poses from which a straight line is tried
_SEARCHES = 4  # poses for which a path is searched where no straight path is free
_SHORTCUTS = 20
_CLEARANCE_POSES = 8
_SAME = 0.05  # solutions of one pose that differ by less count as one
_LONGEST_EDGE = 1.0
_FIRST_LOOK = 8  # stride of the first, coarse check of a long line
_PORTION = 96  # poses scored together at first; each further portion is as large as all before
_SHORT = 8  # poses tried to tell a lift that is too far from no solution
# The search near poses: poses in one round, the most that they are near, and those for which IK is tried.
_NEARBY, _ORIGINS, _NEARBY_TRIED = 480, 24, 48
_TURN_STD_RAD = math.radians(20)  # about the closing axis
# About the pads' width and about the approach, in each round and in all: within the contacts' friction cone.
_TILT_STD_RAD, _MOST_TILT_RAD = math.radians(3), math.radians(8)
# Along the pads' width and along the approach: less than half a pad.
_SHIFT_STD_M, _MOST_SHIFT_M = 0.003, 0.006
_OFF_LINE_M = 0.002  # between neighbouring points, where coordinates are interpolated
_FAR_M = 1.0  # larger clearances are not computed


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
    holds: npt.NDArray[np.int8]  # (K,), the hand holds the object


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
    tries: int
    iterations: int


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


class Work(NamedTuple):
    """Arrays that the search writes into."""

    joints: F64  # (J, 3, 4)
    frames: F64  # (F + 1, 3, 4), the last is the base
    ik: IkWork
    body: Scratch
    hand: HandWork
    own: Scratch
    own_axes: F64  # (K, 3)


new_work = struct(Work)


class Scores(NamedTuple):
    """Arrays that scoring writes into."""

    pose: F64  # (3, 4)
    local: F64  # (3, 4)
    cells: Ints  # (7,)
    feature: F64  # (8,)


new_scores = struct(Scores)


class Found(NamedTuple):
    """A free grasp with its lines; `home` is -1 where no straight path leads to it."""

    T: F64  # (3, 4), world
    q_grasp: F64
    q_pregrasp: F64
    back: F64  # (B, A), grasp to pregrasp
    lift: F64  # (L, A)


new_found = struct(Found)


@compiled
def points_on(length_m: float, step_m: float) -> int:
    """How many points lie on a line, both ends included, at most `step_m` apart."""
    return 1 + int(math.ceil(length_m / step_m - 1e-9))


@compiled
def _moved(T: F64, back_m: float, rise_m: float, out: F64) -> None:
    """The pose (3, 4) drawn back along its approach and raised in the world."""
    out[:] = T
    for i in range(3):
        out[i, 3] -= T[i, 2] * back_m
    out[2, 3] += rise_m


@compiled
def clears_target(hand: Hand, room: Room, limits: Limits, T: F64, opening: int, w: HandWork) -> bool:
    """Whether the hand clears the target along its approach; its core may not touch, its skin may."""
    parts, core = hand.whole, hand.core
    still, rows, at = room.still, room.near_target, w.frame
    n = points_on(limits.pregrasp_m, limits.line_step_m)
    _moved(T, limits.pregrasp_m, 0.0, at[0])
    if hits_still(parts, opening, at, still, rows, ~TARGET, limits.margin_m + limits.slack_m, w.whole):
        return False
    for k in range(n - 1):
        _moved(T, limits.pregrasp_m * k / (n - 1), 0.0, at[0])
        if hits_still(core, opening, at, still, rows, ~TARGET, 0.0, w.core):
            return False
    return True


@compiled
def is_hand_free(hand: Hand, room: Room, limits: Limits, T: F64, opening: int, w: HandWork) -> bool:
    """Whether the hand clears all but the target along its approach and while it lifts."""
    parts = hand.whole
    still, rows, at = room.still, room.near_target, w.frame
    _moved(T, 0.0, 0.0, at[0])
    if hits_still(parts, opening, at, still, rows, TARGET, limits.hand_margin_m, w.whole):
        return False
    n = points_on(limits.pregrasp_m, limits.line_step_m)
    for k in range(n - 1, 0, -1):
        _moved(T, limits.pregrasp_m * k / (n - 1), 0.0, at[0])
        margin_m = limits.margin_m + limits.slack_m if k == n - 1 else limits.hand_margin_m
        if hits_still(parts, opening, at, still, rows, TARGET, margin_m, w.whole):
            return False
    n = points_on(limits.lift_m, limits.line_step_m)
    for k in range(1, n):
        _moved(T, 0.0, limits.lift_m * k / (n - 1), at[0])
        if hits_still(parts, opening, at, still, rows, TARGET, limits.hand_margin_m, w.whole):
            return False
    return True


@compiled
def _free(hand: Hand, room: Room, limits: Limits, poses: Poses, k: int, w: HandWork) -> bool:
    """Whether pose `k` is free for the hand; computed on first use."""
    if poses.clears[k] == 0:
        ok = clears_target(hand, room, limits, poses.T_world_tcp[k], poses.opening[k], w)
        poses.clears[k] = 1 if ok else -1
    if poses.clears[k] < 0:
        return False
    if poses.is_free[k] == 0:
        ok = is_hand_free(hand, room, limits, poses.T_world_tcp[k], poses.opening[k], w)
        poses.is_free[k] = 1 if ok else -1
    return poses.is_free[k] > 0


@compiled
def clear_poses(hand: Hand, room: Room, limits: Limits, T: F64, opening: Ints) -> Bools:
    """Whether the hand at poses (K, 3, 4) clears the target (K,)."""
    still, parts = len(room.still.kind), len(hand.whole.owner)
    w, out = hand_workspace(parts, still), np.empty(len(T), np.bool_)
    for k in range(len(T)):
        out[k] = clears_target(hand, room, limits, T[k], opening[k], w)
    return out


@compiled
def free_poses(hand: Hand, room: Room, limits: Limits, poses: Poses, first: int, end: int) -> int:
    """Check the poses from `first` to `end` in the scene; how many of them are free."""
    w, total = hand_workspace(len(hand.whole.owner), len(room.still.kind)), 0
    for k in range(first, end):
        total += _free(hand, room, limits, poses, k, w)
    return total


@compiled
def hand_workspace(parts: int, still: int) -> HandWork:
    """Arrays for checks of the hand alone."""
    return new_hand_work(np.empty((1, 3, 4)), scratch_of(parts, still), scratch_of(parts, still))


@compiled
def workspace(arm: Arm, hand: Hand, room: Room) -> Work:
    """Arrays for one candidate: no result depends on earlier ones."""
    still, parts = len(room.still.kind), len(hand.whole.owner)
    own = scratch_of(len(arm.own.owner), 0)
    radii_m(arm.own, own.half_m[:, 0])
    return new_work(
        np.empty((len(arm.tree.parent), 3, 4)),
        np.empty((len(arm.tree.frame_joint) + 1, 3, 4)),
        ik_workspace(arm.tree),
        scratch_of(len(arm.body.owner), still),
        hand_workspace(parts, still),
        own,
        np.zeros((len(arm.own_pairs), 3)),
    )


@compiled
def _pose_arm(arm: Arm, T_root: F64, q: F64, w: Work) -> None:
    joint_poses(arm.tree, T_root, q, w.joints)
    frame_poses(arm.tree, T_root, w.joints, w.frames)
    w.frames[-1] = T_root


@compiled
def is_blocked(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    T_root: F64,
    rows: Ints,
    q: F64,
    opening: int,
    ignored: int,
    w: Work,
) -> bool:
    """Whether the arm, and with an opening of 0 or more the hand, collides at the coordinates (A,)."""
    _pose_arm(arm, T_root, q, w)
    if hits_still(arm.body, 0, w.frames, room.still, rows, ignored, limits.margin_m, w.body):
        return True
    if opening >= 0:
        w.hand.frame[0] = w.frames[-2]
        parts = hand.whole
        if hits_still(parts, opening, w.hand.frame, room.still, rows, ignored, limits.margin_m, w.hand.whole):
            return True
    return hits_itself(arm.own, arm.own_pairs, w.frames, w.own_axes, w.own)


@compiled
def _length(arm: Arm, a: F64, b: F64) -> float:
    s = 0.0
    for m in range(len(a)):
        s += ((b[m] - a[m]) * arm.weight[m]) ** 2
    return math.sqrt(s)


@compiled
def _steps(arm: Arm, a: F64, b: F64, step: float) -> int:
    return max(1, int(math.ceil(_length(arm, a, b) / step - 1e-9)))


@compiled
def _between(a: F64, b: F64, k: int, n: int, out: F64) -> None:
    """Point k of n on the straight line; the last is b to the bit, so that lines join."""
    for m in range(len(a)):
        out[m] = b[m] if k == n else a[m] + k / n * (b[m] - a[m])


@compiled
def is_line_free(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    T_root: F64,
    rows: Ints,
    a: F64,
    b: F64,
    opening: int,
    ignored: int,
    w: Work,
) -> bool:
    """Whether nothing on the straight line after `a` collides; looks at a sparse subset first."""
    n = _steps(arm, a, b, limits.step)
    q = np.empty(len(a))
    sparse = n > 2 * _FIRST_LOOK
    for look in range(2 if sparse else 1):
        for k in range(1, n + 1):
            if sparse and ((k - 1) % _FIRST_LOOK == _FIRST_LOOK // 2) != (look == 0):
                continue
            _between(a, b, k, n, q)
            if is_blocked(arm, hand, room, limits, T_root, rows, q, opening, ignored, w):
                return False
    return True


@compiled
def _follow(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    T_root: F64,
    rows: Ints,
    T: F64,
    back_m: float,
    rise_m: float,
    q_first: F64,
    q_last: F64,
    is_end_known: bool,
    ignored: int,
    w: Work,
    out: F64,
) -> bool:
    """Coordinates (n, A) along a straight line of the hand that begins at `q_first`; whether all is free.

    It fails where a pose has no solution, a coordinate jumps, the hand leaves the line by more than 2 mm in
    between, or the arm collides. The hand's own line is known to be free.
    """
    n, count = len(out), len(q_first)
    goal, before = np.empty((3, 4)), np.empty((3, 4))
    middle, q, at = np.empty(count), np.empty(count), np.empty((3, 4))
    out[0] = q_first
    _moved(T, 0.0, 0.0, before)
    for k in range(1, n):
        _moved(T, back_m * k / (n - 1), rise_m * k / (n - 1), goal)
        if is_end_known and k == n - 1:
            out[k] = q_last
        else:
            for m in range(count):
                # The seed: a step towards the known end, or the last step again.
                if is_end_known:
                    step = (q_last[m] - out[k - 1, m]) / (n - k)
                else:
                    step = out[k - 1, m] - out[max(k - 2, 0), m]
                q[m] = out[k - 1, m] + step
            if not solve(arm.tree, T_root, goal, q, w.ik):
                return False
            out[k] = q
        for m in range(count):
            if abs(out[k, m] - out[k - 1, m]) * arm.weight[m] > limits.jump:
                return False
            middle[m] = (out[k, m] + out[k - 1, m]) / 2
        joint_poses(arm.tree, T_root, middle, w.joints)
        tcp_pose(arm.tree, T_root, w.joints, at)
        off = 0.0
        for i in range(3):
            off += (at[i, 3] - (goal[i, 3] + before[i, 3]) / 2) ** 2
        if off > _OFF_LINE_M**2:
            return False
        before[:] = goal
    if is_blocked(arm, hand, room, limits, T_root, rows, q_first, -1, ignored, w):
        return False
    for k in range(1, n):
        if not is_line_free(arm, hand, room, limits, T_root, rows, out[k - 1], out[k], -1, ignored, w):
            return False
    return True


@compiled
def _nearest(arm: Arm, tree: F64, n: int, q: F64) -> int:
    best, least = 0, np.inf
    for k in range(n):
        s = 0.0
        for m in range(len(q)):
            s += ((tree[k, m] - q[m]) * arm.weight[m]) ** 2
        if s < least:
            best, least = k, s
    return best


@compiled
def _advance(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    T_root: F64,
    rows: Ints,
    opening: int,
    tree: F64,
    parent: Ints,
    n: int,
    q_to: F64,
    longest: float,
    w: Work,
) -> tuple[int, bool]:
    """Grow from the nearest node towards `q_to` as far as the line is free; the new number, and if it got there."""
    at = _nearest(arm, tree, n, q_to)
    length = _length(arm, tree[at], q_to)
    end, q = q_to.copy(), np.empty(len(q_to))
    whole = length <= longest
    if not whole:
        for m in range(len(q_to)):
            end[m] = tree[at, m] + (q_to[m] - tree[at, m]) * (longest / length)
    steps, free = _steps(arm, tree[at], end, limits.step), 0
    for k in range(1, steps + 1):
        _between(tree[at], end, k, steps, q)
        if is_blocked(arm, hand, room, limits, T_root, rows, q, opening, 0, w):
            break
        free = k
    if free == 0:
        return n, False
    _between(tree[at], end, free, steps, tree[n])
    parent[n] = at
    return n + 1, whole and free == steps


@compiled
def connect(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    T_root: F64,
    rows: Ints,
    opening: int,
    q_start: F64,
    q_goal: F64,
    iterations: int,
    w: Work,
    rng: np.random.Generator,
) -> tuple[F64, int]:
    """Corners (K, A) of a free path by RRT-Connect (Kuffner and LaValle 2000), and the samples used; K may be 0.

    Each sample extends one tree by an edge of at most 1 rad towards it; the other tree then grows straight
    towards the new end as far as the line is free. The trees take turns.
    """
    count = len(q_start)
    trees, parents = np.empty((2, 2 * iterations + 2, count)), np.empty((2, 2 * iterations + 2), np.int64)
    trees[0, 0], trees[1, 0] = q_start, q_goal
    parents[:, 0] = -1
    sizes = np.ones(2, np.int64)
    sample = np.empty(count)
    for k in range(iterations):
        a, b = k % 2, 1 - k % 2
        for m in range(count):
            low, high = max(arm.tree.lower[m], -math.pi), min(arm.tree.upper[m], math.pi)
            sample[m] = low + (high - low) * rng.random()
        before = sizes[a]
        sizes[a], _ = _advance(
            arm, hand, room, limits, T_root, rows, opening, trees[a], parents[a], before, sample,
            _LONGEST_EDGE, w,
        )  # fmt: skip
        if sizes[a] == before:
            continue
        sizes[b], met = _advance(
            arm, hand, room, limits, T_root, rows, opening, trees[b], parents[b], sizes[b],
            trees[a, before], np.inf, w,
        )  # fmt: skip
        if met:
            return _joined(trees, parents, sizes), k + 1
    return trees[0, :0], iterations


@compiled
def _joined(trees: F64, parents: Ints, sizes: Ints) -> F64:
    """The way from the first root to the second, through the last node of each tree, which are the same."""
    lengths = np.zeros(2, np.int64)
    for t in range(2):
        row = sizes[t] - 1
        while row >= 0:
            lengths[t] += 1
            row = parents[t, row]
    out = np.empty((lengths[0] + lengths[1] - 1, trees.shape[2]))
    row, at = sizes[0] - 1, lengths[0] - 1
    while row >= 0:
        out[at] = trees[0, row]
        at -= 1
        row = parents[0, row]
    row, at = parents[1, sizes[1] - 1], lengths[0]
    while row >= 0:
        out[at] = trees[1, row]
        at += 1
        row = parents[1, row]
    return out


@compiled
def dense(arm: Arm, corners: F64, step: float) -> F64:
    """The polyline through corners (K, A), as configurations (M, A) at most `step` apart."""
    total = 1
    for k in range(1, len(corners)):
        total += _steps(arm, corners[k - 1], corners[k], step)
    out = np.empty((total, corners.shape[1]))
    out[0] = corners[0]
    at = 1
    for k in range(1, len(corners)):
        n = _steps(arm, corners[k - 1], corners[k], step)
        for i in range(1, n + 1):
            _between(corners[k - 1], corners[k], i, n, out[at])
            at += 1
    return out


@compiled
def _shortened(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    T_root: F64,
    rows: Ints,
    opening: int,
    path: F64,
    w: Work,
    rng: np.random.Generator,
) -> F64:
    """A dense path (M, A) with shortcuts: straight lines between random rows of it, where free."""
    for _ in range(_SHORTCUTS):
        i, j = rng.integers(0, len(path)), rng.integers(0, len(path))
        if i > j:
            i, j = j, i
        way = 0.0
        for k in range(i, j):
            way += _length(arm, path[k], path[k + 1])
        if _length(arm, path[i], path[j]) >= way - limits.step / 10:
            continue
        if is_line_free(arm, hand, room, limits, T_root, rows, path[i], path[j], opening, 0, w):
            n = _steps(arm, path[i], path[j], limits.step)
            new = np.empty((i + 1 + n + len(path) - j - 1, path.shape[1]))
            new[: i + 1] = path[: i + 1]
            for k in range(1, n + 1):
                _between(path[i], path[j], k, n, new[i + k])
            new[i + n + 1 :] = path[j + 1 :]
            path = new
    return path


class Plan(NamedTuple):
    """What a search found: its furthest stage, and with `SUCCESS` the whole plan."""

    stage: int
    tried: int  # poses for which inverse kinematics was tried
    pose: int  # row of the poses, or -1 for one near them
    T_world_tcp: F64  # (3, 4)
    opening: int
    home: int
    q_reach: F64  # (M, A)
    q_approach: F64  # (B, A)
    q_lift: F64  # (L, A)
    length: float  # of reach and approach, radians
    clearance_m: float
    asks: bool  # whether it is not known yet that the hand holds the object there


@compiled
def _no_plan(arm: Arm, stage: int, tried: int) -> Plan:
    none = np.empty((0, len(arm.weight)))
    return Plan(stage, tried, -1, np.zeros((3, 4)), 0, -1, none, none, none, 0.0, 0.0, False)


class Base(NamedTuple):
    """One base pose in a scene, and what the search knows there."""

    T_root: F64  # (3, 4), world
    rows: Ints  # still parts within the arm's reach
    homes: npt.NDArray[np.int8]  # (H,), 1 where the tucked pose is free, -1 where not, 0 not known
    far_T: F64  # (S, 3, 4), poses without a free straight path
    far_q: F64  # (S, 2, A), at the grasp and the pregrasp
    far_of: Ints  # (S, 2), row and opening
    counts: Ints  # (2,), how many of `far_T` are filled; whether the base itself is stuck


new_base = struct(Base)


@compiled
def _fully_open(hand: Hand) -> int:
    return len(hand.whole.center_m) // len(hand.whole.owner) - 1


@compiled
def _has_free_home(arm: Arm, hand: Hand, room: Room, limits: Limits, base: Base, open_: int, w: Work) -> bool:
    for h in range(len(arm.homes)):
        if base.homes[h] == 0:
            hit = is_blocked(arm, hand, room, limits, base.T_root, base.rows, arm.homes[h], open_, 0, w)
            base.homes[h] = -1 if hit else 1
    return base.homes.max() > 0


@compiled
def _homes_by_distance(arm: Arm, base: Base, q: F64) -> Ints:
    far = np.full(len(arm.homes), np.inf)
    for h in range(len(arm.homes)):
        if base.homes[h] > 0:
            far[h] = _length(arm, arm.homes[h], q)
    return np.argsort(far, kind="mergesort")


@compiled
def _try_pose(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    row: int,
    T: F64,
    opening: int,
    w: Work,
    found: Found,
) -> tuple[int, int]:
    """The furthest stage that a free pose of the hand (3, 4) leads to, and the tucked pose it is reached from.

    Cheap checks come first; `found` gets the lines of a success.
    """
    count, stage, home = len(arm.weight), NO_IK, -1
    T_root, rows = base.T_root, base.rows
    local, pregrasp, lifted = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    _inverse_times(T_root, T, local)
    _moved(T, limits.pregrasp_m, 0.0, pregrasp)
    _moved(T, 0.0, limits.lift_m, lifted)
    starts = np.empty((limits.seeds, count))
    n = seeds(
        arm.reach,
        arm.tree,
        local,
        starts,
        np.empty(7, np.int64),
        np.empty(8),
        np.empty((24, count)),
        np.empty(24),
    )
    known = np.empty((limits.seeds, count))
    ways = 0
    for s in range(n):
        q = found.q_grasp
        q[:] = starts[s]
        if not solve(arm.tree, T_root, T, q, w.ik):
            continue
        is_known = False
        for k in range(ways):
            apart = 0.0
            for m in range(count):
                apart = max(apart, abs(q[m] - known[k, m]))
            is_known |= apart < _SAME
        if is_known:
            continue
        known[ways] = q
        ways += 1
        found.q_pregrasp[:] = q
        if not solve(arm.tree, T_root, pregrasp, found.q_pregrasp, w.ik):
            continue
        stage = max(stage, ARM_COLLISION)
        if base.counts[1]:
            return stage, home
        if is_blocked(arm, hand, room, limits, T_root, rows, found.q_pregrasp, opening, 0, w):
            continue
        if is_blocked(arm, hand, room, limits, T_root, rows, q, -1, 0, w):
            continue
        if not _has_free_home(arm, hand, room, limits, base, _fully_open(hand), w):
            return NO_START, home
        stage = max(stage, NO_APPROACH)
        # The end of the lift is checked first: where the arm is too short for it, the lines cost most.
        found.lift[-1] = q
        if not solve(arm.tree, T_root, lifted, found.lift[-1], w.ik):
            stage = max(stage, NO_LIFT)
            continue
        if not _follow(
            arm, hand, room, limits, T_root, rows, T, limits.pregrasp_m, 0.0, q, found.q_pregrasp, True, 0, w,
            found.back,
        ):  # fmt: skip
            continue
        stage = max(stage, NO_LIFT)
        if not _follow(
            arm, hand, room, limits, T_root, rows, T, 0.0, limits.lift_m, q, q, False, TARGET, w, found.lift
        ):
            continue
        stage = max(stage, NO_PATH)
        order = _homes_by_distance(arm, base, found.q_pregrasp)
        for h in order[:_STARTS]:
            if base.homes[h] > 0 and is_line_free(
                arm, hand, room, limits, T_root, rows, arm.homes[h], found.q_pregrasp, opening, 0, w
            ):
                found.T[:] = T
                return SUCCESS, h
        k = base.counts[0]
        if k < _SEARCHES:
            base.far_T[k], base.far_q[k, 0], base.far_q[k, 1] = T, q, found.q_pregrasp
            base.far_of[k, 0], base.far_of[k, 1] = row, opening
            base.counts[0] += 1
    return stage, home


@compiled
def _inverse_times(A: F64, B: F64, out: F64) -> None:
    """out = inverse(A) B for poses (3, 4)."""
    for i in range(3):
        for k in range(4):
            s = 0.0
            for m in range(3):
                s += A[m, i] * (B[m, k] - (A[m, 3] if k == 3 else 0.0))
            out[i, k] = s


@compiled
def _whole(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    tried: int,
    row: int,
    opening: int,
    home: int,
    q_reach: F64,
    found: Found,
    asks: bool,
    w: Work,
) -> Plan:
    length = 0.0
    for k in range(1, len(q_reach)):
        length += _length(arm, q_reach[k - 1], q_reach[k])
    for k in range(1, len(found.back)):
        length += _length(arm, found.back[k - 1], found.back[k])
    clearance_m, some = _FAR_M, min(_CLEARANCE_POSES, len(q_reach))
    parts = hand.whole
    for look in range(2):  # first the parts whose boxes are nearest: then few others need a distance
        for k in range(some):
            q = q_reach[int(round(k * (len(q_reach) - 1) / max(some - 1, 1)))]
            _pose_arm(arm, base.T_root, q, w)
            w.hand.frame[0] = w.frames[-2]
            clearance_m = smallest_gap_m(
                parts, opening, w.hand.frame, room.still, base.rows, look == 0, clearance_m, w.hand.whole
            )
            clearance_m = smallest_gap_m(
                arm.body, 0, w.frames, room.still, base.rows, look == 0, clearance_m, w.body
            )
    return Plan(
        SUCCESS, tried, row, found.T.copy(), opening, home, q_reach, found.back[::-1].copy(), found.lift.copy(),
        length, clearance_m, asks,
    )  # fmt: skip


@compiled
def _straight(arm: Arm, a: F64, b: F64, step: float) -> F64:
    corners = np.empty((2, len(a)))
    corners[0], corners[1] = a, b
    return dense(arm, corners, step)


@compiled
def base_at(arm: Arm, room: Room, T_root: F64, reach_m: float, shoulder_m: F64, w: Work) -> Base:
    """The still parts within reach of a base pose, and whether the robot's fixed links collide there."""
    center = np.empty(3)
    for i in range(3):
        center[i] = T_root[i, 3]
        for k in range(3):
            center[i] += T_root[i, k] * shoulder_m[k]
    rows, n = np.empty(len(room.still.kind), np.int64), 0
    for f in range(len(rows)):
        is_near = True
        for i in range(3):
            is_near &= room.still.low_m[f, i] <= center[i] + reach_m
            is_near &= room.still.high_m[f, i] >= center[i] - reach_m
        if is_near:
            rows[n] = f
            n += 1
    rows = rows[:n].copy()
    count = len(arm.weight)
    counts = np.zeros(2, np.int64)
    frames = np.empty((len(arm.tree.frame_joint), 3, 4))
    for f in range(len(frames)):
        _compose(T_root, arm.tree.T_joint_frame[f], frames[f])
    s = scratch_of(len(arm.fixed.owner), len(room.still.kind))
    counts[1] = hits_still(arm.fixed, 0, frames, room.still, rows, FLOOR, 0.0, s)
    return new_base(
        T_root, rows, np.zeros(len(arm.homes), np.int8), np.empty((_SEARCHES, 3, 4)),
        np.empty((_SEARCHES, 2, count)), np.empty((_SEARCHES, 2), np.int64), counts,
    )  # fmt: skip


@compiled
def _compose(A: F64, B: F64, out: F64) -> None:
    for i in range(3):
        for k in range(4):
            out[i, k] = A[i, 0] * B[0, k] + A[i, 1] * B[1, k] + A[i, 2] * B[2, k]
        out[i, 3] += A[i, 3]


@compiled
def _score(arm: Arm, limits: Limits, base: Base, T: F64, s: Scores) -> tuple[int, int]:
    """Samples near a pose (3, 4) of the hand and its pregrasp, the fewer of both; and with the lifted pose too."""
    _inverse_times(base.T_root, T, s.local)
    n = score(arm.reach, s.local, s.cells, s.feature)
    if n == 0:
        return 0, 0
    _moved(T, limits.pregrasp_m, 0.0, s.pose)
    _inverse_times(base.T_root, s.pose, s.local)
    n = min(n, score(arm.reach, s.local, s.cells, s.feature))
    if n == 0:
        return 0, 0
    _moved(T, 0.0, limits.lift_m, s.pose)
    _inverse_times(base.T_root, s.pose, s.local)
    return n, min(n, score(arm.reach, s.local, s.cells, s.feature))


@compiled
def _try(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    poses: Poses,
    k: int,
    tried: int,
    found: Found,
    w: Work,
) -> Plan:
    """Try the free pose `k`: the stage it leads to, with a whole plan where that is `SUCCESS`."""
    T, opening = poses.T_world_tcp[k], poses.opening[k]
    stage, home = _try_pose(arm, hand, room, limits, base, k, T, opening, w, found)
    if stage != SUCCESS:
        return _no_plan(arm, stage, tried + 1)
    q_reach = _straight(arm, arm.homes[home], found.q_pregrasp, limits.step)
    asks = poses.holds[k] == 0
    return _whole(arm, hand, room, limits, base, tried + 1, k, opening, home, q_reach, found, asks, w)


@compiled
def search(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    poses: Poses,
    first: int,
    T_root: F64,
    reach_m: float,
    shoulder_m: F64,
    rounds: int,
    skips: int,
    rng: np.random.Generator,
) -> Plan:
    """Search for a whole plan from the base pose (3, 4) to any of the poses, then near those that came furthest.

    Poses with most samples of the reach map near them come first. A success at a pose whose hold is not known
    `asks`; one near the poses too, except the first `skips`, which are known not to hold.
    """
    w = workspace(arm, hand, room)
    base = base_at(arm, room, T_root, reach_m, shoulder_m, w)
    count = len(arm.weight)
    found = new_found(
        np.empty((3, 4)), np.empty(count), np.empty(count),
        np.empty((points_on(limits.pregrasp_m, limits.line_step_m), count)),
        np.empty((points_on(limits.lift_m, limits.line_step_m), count)),
    )  # fmt: skip
    scores = new_scores(np.empty((3, 4)), np.empty((3, 4)), np.empty(7, np.int64), np.empty(8))
    stages, order = np.full(len(poses.opening), -1, np.int8), np.empty(len(poses.opening), np.int64)
    short, shorts = np.empty(_SHORT, np.int64), 0  # poses from which the arm is too short to lift
    furthest, tried, start, end = NO_IK, 0, 0, max(first, _PORTION)
    while start < len(order) and tried < limits.tries:
        end = min(end, len(order))
        some = np.zeros(end - start)
        for k in range(start, end):
            if poses.holds[k] >= 0 and _free(hand, room, limits, poses, k, w.hand):
                reached, lifted = _score(arm, limits, base, poses.T_world_tcp[k], scores)
                some[k - start] = -lifted
                if lifted == 0 and reached > 0 and shorts < _SHORT:
                    short[shorts] = k
                    shorts += 1
        for k in np.argsort(some, kind="mergesort"):
            if some[k] == 0 or tried >= limits.tries:
                break
            plan = _try(arm, hand, room, limits, base, poses, start + k, tried, found, w)
            tried = plan.tried
            stages[start + k] = plan.stage
            furthest = max(furthest, plan.stage)
            if plan.stage == SUCCESS or plan.stage == NO_START:
                return plan
        start, end = end, 2 * end
    for k in short[:shorts]:
        # They get no further than the lift.
        if furthest < NO_LIFT:
            furthest = max(furthest, _try(arm, hand, room, limits, base, poses, k, tried, found, w).stage)
    plan = _search_paths(arm, hand, room, limits, base, poses, tried, furthest, found, w, rng)
    if plan.stage == SUCCESS or furthest < NO_APPROACH:
        return plan
    near = _new_near(
        np.empty((_ORIGINS, 3, 4)),
        np.empty(_ORIGINS, np.int64),
        np.zeros((_ORIGINS, 5)),
        np.zeros(1, np.int64),
    )
    best = np.argsort(-stages, kind="mergesort")
    for k in best[:_ORIGINS]:
        if stages[k] < 0:
            break
        m = near.count[0]
        near.T[m], near.opening[m] = poses.T_world_tcp[k], poses.opening[k]
        near.count[0] += 1
    for _ in range(rounds):
        base.counts[0] = 0
        plan, skips = _search_near(
            arm, hand, room, limits, base, poses, near, tried, furthest, skips, found, scores, w, rng
        )
        tried, furthest = plan.tried, max(furthest, plan.stage)
        if plan.stage == SUCCESS or near.count[0] == 0:
            return plan
    return _no_plan(arm, furthest, tried)


class _Near(NamedTuple):
    """Poses that a round of the search near them begins with: a grasp and a motion in its frame."""

    T: F64  # (N, 3, 4), grasps, world
    opening: Ints  # (N,)
    # (N, 5): turn about y, the closing axis; tilts about x and z; shifts along x and z
    motion: F64
    count: Ints  # (1,), how many are filled


_new_near = struct(_Near)


@compiled
def _varied(T: F64, motion: F64, rng: np.random.Generator, new: F64, out: F64) -> None:
    """A random motion near another one, (5,), and the grasp (3, 4) moved by it.

    Both fingers keep their contacts, so that most of these poses hold the object as the grasp does.
    """
    new[0] = motion[0] + _TURN_STD_RAD * rng.standard_normal()
    for k in range(1, 3):
        tilt = motion[k] + _TILT_STD_RAD * rng.standard_normal()
        new[k] = min(max(tilt, -_MOST_TILT_RAD), _MOST_TILT_RAD)
    for k in range(3, 5):
        shift = motion[k] + _SHIFT_STD_M * rng.standard_normal()
        new[k] = min(max(shift, -_MOST_SHIFT_M), _MOST_SHIFT_M)
    for i in range(3):
        out[i] = T[i]
        out[i, 3] += T[i, 0] * new[3] + T[i, 2] * new[4]
    for axis, angle in ((1, new[0]), (0, new[1]), (2, new[2])):
        c, s = math.cos(angle), math.sin(angle)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for i in range(3):
            x, y = out[i, a], out[i, b]
            out[i, a], out[i, b] = c * x + s * y, c * y - s * x


@compiled
def _search_near(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    poses: Poses,
    near: _Near,
    tried: int,
    furthest: int,
    skips: int,
    found: Found,
    scores: Scores,
    w: Work,
    rng: np.random.Generator,
) -> tuple[Plan, int]:
    """One round of the search near poses: `near` then has the best of those tried. Also the skips left."""
    n = near.count[0]
    each = _NEARBY // n
    T, motion = np.empty((n * each, 3, 4)), np.empty((n * each, 5))
    some, opening = np.zeros(n * each), np.empty(n * each, np.int64)
    origin = np.empty(n * each, np.int64)
    for k in range(n * each):
        origin[k], opening[k] = k // each, near.opening[k // each]
        _varied(near.T[origin[k]], near.motion[origin[k]], rng, motion[k], T[k])
        _, lifted = _score(arm, limits, base, T[k], scores)
        if (
            lifted > 0
            and is_hand_free(hand, room, limits, T[k], opening[k], w.hand)
            and clears_target(hand, room, limits, T[k], opening[k], w.hand)
        ):
            some[k] = -lifted
    stages = np.full(n * each, -1, np.int8)
    left = _NEARBY_TRIED
    for k in np.argsort(some, kind="mergesort"):
        if some[k] == 0 or left == 0:
            break
        left -= 1
        tried += 1
        stage, home = _try_pose(arm, hand, room, limits, base, -1, T[k], opening[k], w, found)
        if stage == SUCCESS and skips > 0:
            skips -= 1
            continue
        stages[k] = stage
        furthest = max(furthest, stage)
        if stage == SUCCESS:
            q_reach = _straight(arm, arm.homes[home], found.q_pregrasp, limits.step)
            whole = _whole(
                arm, hand, room, limits, base, tried, -1, opening[k], home, q_reach, found, True, w
            )
            return whole, skips
    if skips == 0:
        plan = _search_paths(arm, hand, room, limits, base, poses, tried, furthest, found, w, rng)
        if plan.stage == SUCCESS:
            return plan, skips
    best, rows = np.argsort(-stages, kind="mergesort"), 0
    next_T, next_motion = np.empty((_ORIGINS, 3, 4)), np.empty((_ORIGINS, 5))
    next_opening = np.empty(_ORIGINS, np.int64)
    for k in best[:_ORIGINS]:
        if stages[k] < ARM_COLLISION:
            break
        next_T[rows], next_motion[rows], next_opening[rows] = near.T[origin[k]], motion[k], opening[k]
        rows += 1
    near.T[:rows], near.motion[:rows], near.opening[:rows] = (
        next_T[:rows],
        next_motion[:rows],
        next_opening[:rows],
    )
    near.count[0] = rows
    return _no_plan(arm, furthest, tried), skips


@compiled
def _search_paths(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    poses: Poses,
    tried: int,
    furthest: int,
    found: Found,
    w: Work,
    rng: np.random.Generator,
) -> Plan:
    """Search a path to the first poses without a straight one; they share the iterations evenly."""
    left, n = limits.iterations, base.counts[0]
    for k in range(n):
        T, q, q_pregrasp = base.far_T[k], base.far_q[k, 0], base.far_q[k, 1]
        row, opening = base.far_of[k, 0], base.far_of[k, 1]
        home = _homes_by_distance(arm, base, q_pregrasp)[0]
        corners, used = connect(
            arm, hand, room, limits, base.T_root, base.rows, opening, arm.homes[home], q_pregrasp,
            left // (n - k), w, rng,
        )  # fmt: skip
        left -= used
        if len(corners) == 0:
            continue
        path = dense(arm, corners, limits.step)
        path = _shortened(arm, hand, room, limits, base.T_root, base.rows, opening, path, w, rng)
        found.T[:] = T
        _follow(
            arm, hand, room, limits, base.T_root, base.rows, T, limits.pregrasp_m, 0.0, q, q_pregrasp, True, 0, w,
            found.back,
        )  # fmt: skip
        _follow(
            arm, hand, room, limits, base.T_root, base.rows, T, 0.0, limits.lift_m, q, q, False, TARGET, w,
            found.lift,
        )  # fmt: skip
        asks = row < 0 or poses.holds[row] == 0
        return _whole(arm, hand, room, limits, base, tried, row, opening, home, path, found, asks, w)
    return _no_plan(arm, furthest, tried)
