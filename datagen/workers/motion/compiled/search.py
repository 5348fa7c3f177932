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
    compose,
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
SEARCHES = 4  # poses for which a path is searched where no straight path is free
_SHORTCUTS = 20
_CLEARANCE_POSES = 8
_SAME = 0.05  # solutions of one pose that differ by less count as one
_LONGEST_EDGE = 1.0
_FIRST_LOOK = 8  # stride of the first, coarse check of a long line
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


class Base(NamedTuple):
    """One base pose in a scene, and what the search has found there so far."""

    T_root: F64  # (3, 4), world
    rows: Ints  # still parts within the arm's reach
    homes: npt.NDArray[np.int8]  # (H,), 1 where the tucked pose is free, -1 where not, 0 not known
    far_T: F64  # (S, 3, 4), free poses without a free straight path
    far_q: F64  # (S, 2, A), at the grasp and the pregrasp
    far: Ints  # (1,), how many are filled
    is_stuck: bool  # the robot collides without its arm


struct(Base)


@compiled
def is_stuck(arm: Arm, room: Room, T_root: F64, rows: Ints) -> bool:
    """Whether links that no joint moves collide with anything but the floor."""
    tree = arm.tree
    frames = np.empty((len(tree.frame_joint), 3, 4))
    for f in range(len(frames)):
        compose(T_root, tree.T_joint_frame[f], frames[f])
    s = scratch_of(len(arm.fixed.owner), len(room.still.kind))
    return hits_still(arm.fixed, 0, frames, room.still, rows, FLOOR, 0.0, s)


@compiled
def new_search(arm: Arm, hand: Hand, room: Room, limits: Limits) -> tuple[Work, Found]:
    """Arrays for one candidate: no result depends on earlier ones."""
    count = len(arm.weight)
    found = new_found(
        np.empty((3, 4)),
        np.empty(count),
        np.empty(count),
        np.empty((points_on(limits.pregrasp_m, limits.line_step_m), count)),
        np.empty((points_on(limits.lift_m, limits.line_step_m), count)),
    )
    return workspace(arm, hand, room), found


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
def _inverse_times(A: F64, B: F64, out: F64) -> None:
    """out = inverse(A) B for poses (3, 4)."""
    for i in range(3):
        for k in range(4):
            s = 0.0
            for m in range(3):
                s += A[m, i] * (B[m, k] - (A[m, 3] if k == 3 else 0.0))
            out[i, k] = s


@compiled
def try_pose(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
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
        if base.is_stuck:
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
        k = base.far[0]
        if k < SEARCHES:
            base.far_T[k], base.far_q[k, 0], base.far_q[k, 1] = T, q, found.q_pregrasp
            base.far[0] += 1
    return stage, home


class Lines(NamedTuple):
    """A whole plan as coordinates; neighbouring rows are joined by straight lines."""

    q_reach: F64  # (M, A), tucked to pregrasp
    q_approach: F64  # (B, A)
    q_lift: F64  # (L, A)
    length: float  # of reach and approach, radians
    clearance_m: float  # smallest distance of arm and scene over `q_reach`


@compiled
def whole_plan(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    opening: int,
    home: int,
    q_reach: F64,
    found: Found,
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
    return Lines(q_reach, found.back[::-1].copy(), found.lift.copy(), length, clearance_m)


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
def best_first(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    poses: Poses,
    start: int,
    end: int,
    short: Ints,
    w: Work,
) -> Ints:
    """The free poses from `start` to `end` that can be reached, those with most samples near them first.

    Poses that can be reached and not lifted go to `short`, behind those that are there, while there is room.
    """
    scores = new_scores(np.empty((3, 4)), np.empty((3, 4)), np.empty(7, np.int64), np.empty(8))
    some = np.zeros(end - start)
    for k in range(start, end):
        if poses.holds[k] < 0 or not _free(hand, room, limits, poses, k, w.hand):
            continue
        reached, lifted = _score(arm, limits, base, poses.T_world_tcp[k], scores)
        some[k - start] = -lifted
        if lifted == 0 and reached > 0:
            for m in range(len(short)):
                if short[m] < 0:
                    short[m] = k
                    break
    order = np.argsort(some, kind="mergesort")
    return start + order[: np.count_nonzero(some)]


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
def poses_near(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    T_grasp: F64,
    before: F64,
    opening: Ints,
    each: int,
    w: Work,
    rng: np.random.Generator,
) -> tuple[F64, F64, Ints]:
    """`each` random poses (N * each, 3, 4) near N poses, their motions (N * each, 5), and the rows to try, best first.

    A pose is a grasp (3, 4) moved in its own frame by a motion (5,): turn about y, tilts about x and z, shifts
    along x and z.
    """
    scores = new_scores(np.empty((3, 4)), np.empty((3, 4)), np.empty(7, np.int64), np.empty(8))
    n = len(T_grasp) * each
    T, motion, some = np.empty((n, 3, 4)), np.empty((n, 5)), np.zeros(n)
    for k in range(n):
        _varied(T_grasp[k // each], before[k // each], rng, motion[k], T[k])
        _, lifted = _score(arm, limits, base, T[k], scores)
        if lifted > 0 and is_hand_free(hand, room, limits, T[k], opening[k // each], w.hand):
            if clears_target(hand, room, limits, T[k], opening[k // each], w.hand):
                some[k] = -lifted
    order = np.argsort(some, kind="mergesort")
    return T, motion, order[: np.count_nonzero(some)]


@compiled
def path_to(
    arm: Arm,
    hand: Hand,
    room: Room,
    limits: Limits,
    base: Base,
    k: int,
    opening: int,
    iterations: int,
    w: Work,
    found: Found,
    rng: np.random.Generator,
) -> tuple[F64, int, int]:
    """A free path (M, A) to pose `k` of those without a straight one, its tucked pose, and the samples used.

    M is 0 where none was found; `found` gets the pose's lines.
    """
    T, q, q_pregrasp = base.far_T[k], base.far_q[k, 0], base.far_q[k, 1]
    home = _homes_by_distance(arm, base, q_pregrasp)[0]
    T_root, rows = base.T_root, base.rows
    corners, used = connect(
        arm, hand, room, limits, T_root, rows, opening, arm.homes[home], q_pregrasp, iterations, w, rng
    )
    if len(corners) == 0:
        return corners, home, used
    path = dense(arm, corners, limits.step)
    path = _shortened(arm, hand, room, limits, T_root, rows, opening, path, w, rng)
    found.T[:] = T
    _follow(
        arm,
        hand,
        room,
        limits,
        T_root,
        rows,
        T,
        limits.pregrasp_m,
        0.0,
        q,
        q_pregrasp,
        True,
        0,
        w,
        found.back,
    )
    _follow(arm, hand, room, limits, T_root, rows, T, 0.0, limits.lift_m, q, q, False, TARGET, w, found.lift)
    return path, home, used


@compiled
def straight_path(arm: Arm, home: int, limits: Limits, found: Found) -> F64:
    """The straight line (M, A) from a tucked pose to the pregrasp."""
    corners = np.empty((2, len(arm.weight)))
    corners[0], corners[1] = arm.homes[home], found.q_pregrasp
    return dense(arm, corners, limits.step)
