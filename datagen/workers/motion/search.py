"""Search for a whole plan from one base pose, compiled: hand, inverse kinematics, lines, paths.

The same checks in the same order for every candidate; all random numbers come from the generator given.
"""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled, constant
from datagen.workers.kinematics.contacts import smallest_gap_m
from datagen.workers.kinematics.inverse import put, put_row, solve
from datagen.workers.kinematics.tree import Ints
from datagen.workers.motion.arm_motion import (
    NO_HAND,
    NO_HOME,
    ONE_SHAPE,
    Search,
    follow,
    has_free_home,
    is_blocked,
    is_line_free,
    length,
    next_home,
    pose_arm,
)
from datagen.workers.motion.hand_motion import NOTHING, TARGET, Poses, is_hand_free, moved
from datagen.workers.motion.path_search import connect, dense, shortened
from datagen.workers.motion.reach_map import score, seeds

# The order of checks of a grasp, cheap ones first. A later cause of failure means more progress.
NOT_FREE = constant(-1)
NO_IK, ARM_COLLISION, NO_START, NO_APPROACH, NO_LIFT, NO_PATH, SUCCESS = range(7)
_STARTS = 3  # tucked poses from which a straight line is tried
_CLEARANCE_POSES = 8
_SAME = 0.05  # solutions of one pose that differ by less count as one
_FAR_M = 1.0  # larger clearances are not computed


@compiled
def _inverse_times(A: F64, B: F64, out: F64) -> None:
    """out = inverse(A) B for poses (3, 4)."""
    for i in range(3):
        for k in range(4):
            total = 0.0
            for m in range(3):
                total += A[m, i] * (B[m, k] - (A[m, 3] if k == 3 else 0.0))
            out[i, k] = total


@compiled
def samples_near(s: Search, poses: Poses, start: int, end: int, near: Ints) -> None:
    """Samples of the reach map near the poses from `start` to `end`, into near (end - start,).

    The least of those near the pose, near its pregrasp and near the end of its lift; -1 where only the end of
    the lift has none, and 0 at other poses.
    """
    # Fields are read once: each time costs more than a line of this.
    reach, T_root, T_world, allowed = s.arm.reach, s.T_root, poses.T_world_tcp, poses.allowed
    local, work, pregrasp_m, lift_m = s.work.reach.local, s.work.reach, s.limits.pregrasp_m, s.limits.lift_m
    for k in range(start, end):
        if not allowed[k]:
            continue
        _inverse_times(T_root, T_world[k], local)
        count = score(reach, local, work)
        if count > 0:  # the pregrasp
            for i in range(3):
                local[i, 3] -= pregrasp_m * local[i, 2]
            count = min(count, score(reach, local, work))
        if count > 0:  # the end of the lift
            for i in range(3):
                local[i, 3] += pregrasp_m * local[i, 2] + lift_m * T_root[2, i]
            count = min(count, score(reach, local, work))
            near[k - start] = count if count > 0 else -1


@compiled
def try_pose(s: Search, poses: Poses, row: int) -> tuple[int, int]:
    """The furthest stage that a pose of the hand leads to, and the tucked pose that it begins at.

    `NOT_FREE` where the hand alone cannot get there. Cheap checks come first. The work gets the lines of a
    success, and of a pose without a straight path.
    """
    arm, limits, w, T_root, T, opening = (
        s.arm,
        s.limits,
        s.work,
        s.T_root,
        poses.T_world_tcp[row],
        poses.opening[row],
    )
    if not is_hand_free(s.hand, s.room, limits, poses, row, w.hand):
        return NOT_FREE, -1
    tree, count, stage, ways = arm.tree, len(arm.weight), NO_IK, 0
    pregrasp, lifted, q = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, count))
    _inverse_times(T_root, T, w.reach.local)
    moved(T, limits.pregrasp_m, 0.0, pregrasp)
    moved(T, 0.0, limits.lift_m, lifted)
    starts, known = np.empty((limits.seeds, count)), np.empty((limits.seeds, count))
    for k in range(seeds(arm.reach, tree, w.reach.local, starts, w.reach)):
        put_row(starts[k], q[0])
        if not solve(tree, T_root, T, q[0], w.ik):
            continue
        is_known = False
        for other in range(ways):
            apart = 0.0
            for m in range(count):
                apart = max(apart, abs(q[0, m] - known[other, m]))
            is_known |= apart < _SAME
        if is_known:
            continue
        put_row(q[0], known[ways])
        ways += 1
        put_row(q[0], q[1])
        if not solve(tree, T_root, pregrasp, q[1], w.ik):
            continue
        stage = max(stage, ARM_COLLISION)
        if s.is_stuck:
            return stage, -1
        if is_blocked(s, q[1], opening, NOTHING) or is_blocked(s, q[0], NO_HAND, NOTHING):
            continue
        if not has_free_home(s):
            return NO_START, -1
        stage = max(stage, NO_APPROACH)
        # The end of the lift is checked first: where the arm is too short for it, the lines cost most.
        put_row(q[0], q[2])
        if not solve(tree, T_root, lifted, q[2], w.ik):
            stage = max(stage, NO_LIFT)
            continue
        at = w.without_path[0]
        back, lift = w.back[at], w.lift[at]
        put_row(q[0], back[0])
        put_row(q[1], back[-1])
        put_row(q[0], lift[0])
        if not follow(s, T, limits.pregrasp_m, 0.0, NOTHING, back):
            continue
        stage = max(stage, NO_LIFT)
        if not follow(s, T, 0.0, limits.lift_m, TARGET, lift):
            continue
        stage = max(stage, NO_PATH)
        home = NO_HOME
        for _ in range(_STARTS):
            home = next_home(s, q[1], home)
            if home < 0:
                break
            if is_line_free(s, arm.homes[home], q[1], opening, NOTHING):
                return SUCCESS, home
        w.without_path[0] = min(at + 1, len(w.back) - 1)
    return stage, -1


@compiled
def try_until(s: Search, poses: Poses, rows: Ints, start: int, most: int, reached: Ints) -> tuple[int, int]:
    """Try these rows of the poses from `start` on, at most `most` free ones, until one could have a path.

    It also ends where no tucked pose is free. Returns the end of the rows tried, whose stages `reached`
    (len(rows),) gets, and the tucked pose of the last.
    """
    n, home = start, NO_HOME
    while n < len(rows) and most > 0:
        stage, home = try_pose(s, poses, rows[n])
        reached[n] = stage
        n += 1
        if stage != NOT_FREE:
            most -= 1
        if stage >= NO_PATH or stage == NO_START:
            break
    return n, home


@compiled
def path_to(
    s: Search, k: int, opening: int, iterations: int, rng: np.random.Generator
) -> tuple[F64, int, int]:
    """A free path (M, A) to grasp `k` of those without a straight one, its tucked pose, and the samples used.

    M is 0 where none was found.
    """
    arm, q_pregrasp = s.arm, s.work.back[k, -1]
    home = next_home(s, q_pregrasp, NO_HOME)
    corners, used = connect(s, opening, arm.homes[home], q_pregrasp, iterations, rng)
    if len(corners) > 0:
        corners = shortened(s, opening, dense(arm.weight, corners, s.limits.step), rng)
    return corners, home, used


@compiled
def length_and_clearance(s: Search, k: int, opening: int, q_reach: F64) -> tuple[float, float]:
    """Radians of a path (M, A) and the approach to grasp `k`, and the smallest distance (m) of arm and scene.

    The distance is that at 8 rows of the path, at most 1 m.
    """
    total, back, w = 0.0, s.work.back[k], s.work
    for row in range(1, len(q_reach)):
        total += length(s.arm.weight, q_reach[row - 1], q_reach[row])
    for row in range(1, len(back)):
        total += length(s.arm.weight, back[row - 1], back[row])
    clearance_m, some, still, hand = _FAR_M, min(_CLEARANCE_POSES, len(q_reach)), s.room.still, w.hand
    for look in range(2):  # first the parts whose boxes are nearest: then few others need a distance
        for row in range(some):
            pose_arm(s, q_reach[round(row * (len(q_reach) - 1) / max(some - 1, 1))])
            put(w.frames[-2], hand.frame[0])
            clearance_m = smallest_gap_m(
                s.hand.whole, opening, hand.frame, still, s.rows, look == 0, clearance_m, hand.whole
            )
            clearance_m = smallest_gap_m(
                s.arm.body, ONE_SHAPE, w.frames, still, s.rows, look == 0, clearance_m, w.body
            )
    return total, clearance_m
