"""Robots and hands as the compiled planner sees them: convex parts, tucked poses, where the hand can be."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from datagen.workers.geometry.mesh import F32, F64, I32
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.contacts import Parts, parts_of
from datagen.workers.kinematics.tree import Bools, Ints, KinematicTree
from datagen.workers.motion.arm_motion import Arm
from datagen.workers.motion.hand_motion import FLOOR, Hand
from datagen.workers.motion.reach_map import AZIMUTHS, CELLS, ReachMap, fill
from datagen.workers.robots.gripper import Gripper
from datagen.workers.robots.robot import Robot

_SAMPLES = 1 << 19  # joint vectors of a reach map
_FIRST_SAMPLES = 1 << 14  # those that decide how far the map extends
_DIGITS = 6  # of an arm's numbers, in units of its length: scaled copies of an arm share samples
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
    angles = 2 * np.pi * np.arange(_PEDESTAL_SIDES) / _PEDESTAL_SIDES
    ring = radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = np.concatenate(
        [np.column_stack([ring, np.full(_PEDESTAL_SIDES, z)]) for z in (bottom_m, top_m)]
    )
    tree, own = arm.tree, arm.own
    frame, part = len(tree.frame_joint), len(own.owner)
    rows = [(a, part) for a in range(part) if tree.frame_joint[own.owner[a]] > 0]
    more = parts_of([*[()] * frame, (corners,)])
    joined = Parts(
        np.concatenate([own.points_m, corners]),
        np.append(own.first, own.first[-1] + len(corners)),
        *(np.concatenate([a, b]) for a, b in zip(own[2:], more[2:], strict=True)),
    )
    pairs = np.concatenate([arm.own_pairs, np.array(rows, np.int64).reshape(-1, 2)])
    return arm._replace(own=joined, own_pairs=pairs)


def hand_of(gripper: Gripper, opening_m: F64) -> Hand:
    """The hand at openings (N,) and, as the last row, fully open."""
    opening_m = np.append(opening_m, gripper.max_opening_m)
    posture = gripper.posture(opening_m)
    sides = [0] * len(gripper.palm_parts_m)
    sides += [s for s, parts in zip((1, -1), gripper.fingers_in[0], strict=True) for _ in parts]
    bodies = [[*gripper.palm_parts_m, *left, *right] for left, right in gripper.fingers_in]
    whole = _slid([list(map(_f64, parts)) for parts in bodies], sides, posture, opening_m)
    core = _slid([list(map(core_of, parts)) for parts in bodies], sides, posture, opening_m)
    return Hand(_shapes(*whole), _shapes(*core))


def _shapes(points: F64, first: Ints, center: F64, half: F64) -> Parts:
    """Parts with one shape an opening (N,), all of one owner."""
    zeros = np.zeros(len(first) - 1, np.int64)
    flat = [a.reshape(-1, 3) for a in (points, center, half)]
    return Parts(flat[0], first, zeros, flat[1], flat[2], zeros)


def _f64(part: F32) -> F64:
    return part.astype(np.float64)


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


def reach_map(tree: KinematicTree, draw: int = 0) -> ReachMap:
    """Where the tree's hand can be. Trees that differ by their scale alone share the samples."""
    length_m = float(np.linalg.norm(tree.T_parent_joint[:, :3, 3], axis=1).sum())
    T_tcp = tree.T_joint_frame[-1]
    turn, axis_xy_m = _upright(tree)

    def shared(values: F64, unit: F64 | float) -> bytes:
        return (np.round(values / unit, _DIGITS) + 0.0).tobytes()  # no negative zero

    T = tree.T_parent_joint.copy()
    T[:, :3, 3] /= length_m
    unit = np.where(_coordinates_that_slide(tree), length_m, 1.0)
    limits = (np.maximum(tree.lower, -np.pi) / unit, np.minimum(tree.upper, np.pi) / unit)
    offset = np.where(tree.slides, tree.offset / length_m, tree.offset)
    found = _samples(
        tree.parent.tobytes(), shared(T, 1.0), tree.axis.tobytes(), tree.slides.tobytes(),
        tree.coordinate.tobytes(), tree.ratio.tobytes(), shared(offset, 1.0),
        *(shared(limit, 1.0) for limit in limits), T_tcp[:3, :3].tobytes(), int(tree.frame_joint[-1]),
        turn, shared(axis_xy_m, length_m), draw,
    )  # fmt: skip
    first, q, half = found
    tcp_wrist_m = -(T_tcp[:3, :3].T @ T_tcp[:3, 3])
    if (unit != 1.0).any():
        q = (q * unit).astype(np.float32)
    return ReachMap(first, q, axis_xy_m, turn, tcp_wrist_m, half * length_m)


@lru_cache(maxsize=16)
def _samples(
    parent: bytes,
    T: bytes,
    axis: bytes,
    slides: bytes,
    coordinate: bytes,
    ratio: bytes,
    offset: bytes,
    lower: bytes,
    upper: bytes,
    R_tcp: bytes,
    tcp_joint: int,
    turn: int,
    axis_xy: bytes,
    draw: int,
) -> tuple[I32, F32, float]:
    """First rows of the cells (C + 1,), sorted joint vectors (N, A) and the map's half width, with the arm's
    length as unit; by its rounded numbers alone, so that the scale that is opened first does not matter."""
    T_wrist = np.eye(4)
    T_wrist[:3, :3] = np.frombuffer(R_tcp).reshape(3, 3)
    low, high = np.frombuffer(lower), np.frombuffer(upper)
    tree = KinematicTree(
        np.frombuffer(parent, np.int64), np.frombuffer(T).reshape(-1, 4, 4),
        np.frombuffer(axis).reshape(-1, 3),
        np.frombuffer(slides, np.bool_), np.frombuffer(coordinate, np.int64), np.frombuffer(ratio),
        np.frombuffer(offset), low, high, np.array([tcp_joint]), T_wrist[None],
    )  # fmt: skip
    tree = KinematicTree(*(np.array(a) for a in tree))  # writable, as the planner's own
    rng = np.random.Generator(np.random.PCG64(draw))
    q = rng.uniform(low, high, (_SAMPLES, len(low)))
    cell, features = np.empty(len(q), np.int64), np.empty((len(q), 8))
    reach = ReachMap(
        np.zeros(1, np.int32),
        q[:0].astype(np.float32),
        np.array(np.frombuffer(axis_xy)),
        turn,
        np.zeros(3),
        1.0,
    )
    some = q[:_FIRST_SAMPLES].copy()
    fill(in_memory(reach), in_memory(tree), some, cell[: len(some)], features)
    half = 1.02 * float(np.abs(features[: len(some), :2]).max())
    fill(in_memory(reach._replace(half_m=half)), in_memory(tree), q, cell, features)
    order = np.argsort(cell, kind="stable")
    count = CELLS if turn >= 0 else CELLS * AZIMUTHS
    first = np.searchsorted(cell[order], np.arange(count + 1)).astype(np.int32)
    return first, q[order].astype(np.float32), half


def _upright(tree: KinematicTree) -> tuple[int, F64]:
    """The coordinate of the first joint that turns, if about a vertical axis, and that axis's x and y (2,).

    Joints below it may slide up and down; -1 where there is none.
    """
    way, j = list[int](), int(tree.frame_joint[-1])
    while j >= 0:
        way.append(j)
        j = int(tree.parent[j])
    T = np.eye(4)
    for j in reversed(way):
        T = T @ tree.T_parent_joint[j]
        axis = T[:3, :3] @ tree.axis[j]
        if np.abs(axis[:2]).max() > 1e-6:
            break
        if not tree.slides[j]:
            # A joint that turns the other way would need the opposite azimuth; others must not turn with it.
            turn = tree.coordinate[j]
            is_plain = axis[2] > 0 and tree.ratio[j] == 1.0 and np.count_nonzero(tree.coordinate == turn) == 1
            return (int(turn), T[:2, 3].copy()) if is_plain else (-1, np.zeros(2))
    return -1, np.zeros(2)


def _coordinates_that_slide(tree: KinematicTree) -> Bools:
    slides = np.zeros(len(tree.lower), np.bool_)
    slides[tree.coordinate[tree.slides]] = True
    return slides
