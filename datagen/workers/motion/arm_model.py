"""Robots and hands as the compiled planner sees them: convex parts, tucked poses, where the hand can be."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import prism_corners, unit_circle
from datagen.workers.kinematics.contacts import Parts, parts_of
from datagen.workers.kinematics.tree import Bools, Ints
from datagen.workers.motion.arm_motion import Arm
from datagen.workers.motion.hand_motion import FLOOR, Hand
from datagen.workers.motion.reach_map import reach_map
from datagen.workers.robots.gripper import Gripper
from datagen.workers.robots.robot import Robot

_RAD_PER_M = 2.0  # a joint that slides by 1 m counts as one that turns by this much
_ARMS_KEPT = 128
# Depth to which hand and target may overlap on the approach: convex parts are thicker than the object.
TOUCH_M = 0.002
_PEDESTAL_SIDES = 16
_PEDESTAL_GAP_M = 0.02  # between the pedestal's top and the mount

_arms: OrderedDict[tuple[int, int], tuple[Robot, Arm]] = OrderedDict()


def arm_of(robot: Robot, draw: int = 0) -> Arm:
    """The robot without a pedestal, built once for all mount heights. `draw` seeds its reach map."""
    # Copies of an arm at other heights share their parts. The stored robot keeps the id of its parts in use.
    key = (id(robot.link_parts_m), draw)
    if key in _arms:
        _arms.move_to_end(key)
        return _arms[key][1]
    tree = robot.tree.along_z()
    links = robot.link_parts_m[: robot.first_hand_link]
    moves = tree.frame_joint[: len(links)] >= 0
    arm = Arm(
        tree,
        parts_of(_only(links, moves), [int(FLOOR) * int(stands) for stands in robot.is_base[: len(links)]]),
        parts_of(_only(links, ~moves)),
        robot.self_collision.parts,
        robot.self_collision.part_pairs,
        np.ascontiguousarray(robot.homes_rad),
        np.where(robot.slides, _RAD_PER_M, 1.0),
        reach_map(tree, draw),
    )
    _arms[key] = (robot, arm)
    if len(_arms) > _ARMS_KEPT:
        _arms.popitem(last=False)
    return arm


def _only(parts: Sequence[Sequence[F32]], rows: Bools) -> list[Sequence[F32]]:
    return [some if chosen else () for some, chosen in zip(parts, rows.tolist(), strict=True)]


def on_pedestal(arm: Arm, base_height_m: float, radius_m: float) -> Arm:
    """The arm on a prism from the floor to just below the mount, which only its first link may touch."""
    top_m, bottom_m = -_PEDESTAL_GAP_M, -base_height_m
    if top_m <= bottom_m or radius_m <= 0:
        return arm
    corners = prism_corners(radius_m * unit_circle(_PEDESTAL_SIDES), bottom_m, top_m)
    tree, own = arm.tree, arm.own
    frame, part = len(tree.frame_joint), len(own.owner)
    rows = [(a, part) for a in range(part) if tree.frame_joint[own.owner[a]] > 0]
    more = parts_of([*[()] * frame, (corners,)])
    joined = Parts(
        np.concatenate([own.points_m, corners]),
        np.append(own.first, own.first[-1] + len(corners)),
        np.append(own.owner, more.owner),
        np.concatenate([own.center_m, more.center_m]),
        np.concatenate([own.half_m, more.half_m]),
        np.append(own.touches, more.touches),
    )
    pairs = np.concatenate([arm.own_pairs, np.array(rows, np.int64).reshape(-1, 2)])
    return arm._replace(own=joined, own_pairs=pairs)


def hand_of(gripper: Gripper, opening_m: F64) -> Hand:
    """The hand at openings (N,) and, as the last row, fully open."""
    opening_m = np.append(opening_m, gripper.max_opening_m)
    posture = gripper.posture(opening_m)
    sides = [0] * len(gripper.palm_parts_m)
    sides += [s for s, parts in zip((1, -1), gripper.fingers_in[0], strict=True) for _ in parts]
    whole, core = (_shapes(*_slid(bodies, sides, posture, opening_m)) for bodies in _bodies(gripper))
    return Hand(whole, core)


@lru_cache(maxsize=8)
def _bodies(gripper: Gripper) -> tuple[list[list[F64]], list[list[F64]]]:
    """The hand's parts in each posture, each (V, 3), and what lies inside them."""
    bodies = [[*gripper.palm_parts_m, *left, *right] for left, right in gripper.fingers_in]
    whole = [[part.astype(np.float64) for part in parts] for parts in bodies]
    return whole, [list(map(core_of, parts)) for parts in bodies]


def _shapes(points: F64, first: Ints, center: F64, half: F64) -> Parts:
    """Parts with one shape an opening (N,), all of one owner."""
    zeros = np.zeros(len(first) - 1, np.int64)
    flat = [a.reshape(-1, 3) for a in (points, center, half)]
    return Parts(flat[0], first, zeros, flat[1], flat[2], zeros)


def core_of(part: F32, depth_m: float = TOUCH_M) -> F64:
    """Corners of the points at least `depth_m` inside a convex part (V, 3); a thinner one has its middle."""
    hull = ConvexHull(part.astype(np.float64))
    middle = hull.points[hull.vertices].mean(axis=0)
    planes = hull.equations.copy()
    planes[:, 3] += depth_m
    if (planes[:, :3] @ middle + planes[:, 3]).max() >= 0:
        return middle[None].repeat(4, axis=0)
    try:
        return np.unique(HalfspaceIntersection(planes, middle).intersections.round(9), axis=0)
    except QhullError:
        return middle[None].repeat(4, axis=0)


def _slid(
    postures: list[list[F64]], sides: list[int], posture: Ints, opening_m: F64
) -> tuple[F64, Ints, F64, F64]:
    """Corners (N, V, 3), rows of parts (P + 1,), boxes' centres and half sizes (N, P, 3) at openings (N,).

    A part's corners differ in number between postures where it is cut: the last one is repeated.
    """
    width = [max(len(parts[p]) for parts in postures) for p in range(len(sides))]
    first = np.cumsum([0, *width])
    table = np.stack(
        [
            np.concatenate([_filled(part, n) for part, n in zip(parts, width, strict=True)])
            for parts in postures
        ]
    )
    points = table[posture]
    points[:, :, 1] += np.repeat(sides, width) * (opening_m / 2)[:, None]
    low, high = (f.reduceat(points, first[:-1], axis=1) for f in (np.minimum, np.maximum))
    return np.ascontiguousarray(points), first, (low + high) / 2, (high - low) / 2


def _filled(points: F64, count: int) -> F64:
    return np.concatenate([points, points[-1:].repeat(count - len(points), axis=0)])
