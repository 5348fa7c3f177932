"""Where a hand can be, seen from its base, with joint vectors that bring it near: a capability map.

Random joint vectors are sorted into cells of the wrist's height and distance and the hand's direction and
roll (Zacharias, Borst, Hirzinger 2007). An arm whose first turning joint stands upright is turned to the
front first, so that this joint need not be sampled; for others the azimuth is one more axis.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from hashlib import sha256
from typing import NamedTuple

import numpy as np

from datagen.workers.content_cache import Arrays, CacheFolder
from datagen.workers.geometry.mesh import F32, F64, I32
from datagen.workers.kinematics.compiler import code_folder, compiled, in_memory, struct
from datagen.workers.kinematics.inverse import joint_poses, one_turn, tcp_pose
from datagen.workers.kinematics.tree import Ints, KinematicTree
from datagen.workers.motion.reach_cells import AZIMUTHS, DIRECTIONS, DISTANCES, HEIGHTS, ROLLS, SIDES

_SAMPLES = 1 << 19  # joint vectors of a map
_FIRST_SAMPLES = 1 << 14  # those that decide how far it extends
_DIGITS = 6  # of an arm's numbers, in units of its length: scaled copies of an arm share samples
_MAPS_KEPT = 16
_MAPS = CacheFolder("reach-maps", most_files=32)  # about 17 MB each
_APART = 1.0  # seeds with all coordinates nearer than this often lead to one solution
_MOST_NEAR = 24  # samples among which seeds are chosen


class ReachMap(NamedTuple):
    """Samples of joint vectors, sorted by cell."""

    first: I32  # (C + 1,), rows of each cell's samples
    q: F32  # (N, A), the hand turned to the front
    axis_xy_m: F64  # (2,), base frame, of the upright axis
    turn: int  # the coordinate that turns about it; -1 where there is none
    tcp_wrist_m: F64  # (3,), TCP frame
    half_m: float  # largest distance and height of the wrist
    near: I32  # (C,), samples in and next to each cell: its own count eight times


struct(ReachMap)


class ReachWork(NamedTuple):
    """Arrays that `score` and `seeds` write into."""

    local: F64  # (3, 4), for the caller: a pose in the base frame
    cells: Ints  # (7,)
    feature: F64  # (8,)
    near: F64  # (24, A)
    gap: F64  # (24,)


new_reach_work = struct(ReachWork)


@compiled
def reach_workspace(coordinates: int) -> ReachWork:
    """Arrays for a number of coordinates."""
    return new_reach_work(
        np.empty((3, 4)),
        np.empty(7, np.int64),
        np.empty(8),
        np.empty((_MOST_NEAR, coordinates)),
        np.empty(_MOST_NEAR),
    )


@compiled
def cell_of(distance: float, height: float, azimuth: float, a: F64, c: F64, turns: bool) -> int:
    """The cell of a hand at a distance and height (-1 to 1), with approach a and closing axis c, (3,)."""
    i = min(int(distance * DISTANCES), DISTANCES - 1)
    k = min(max(int((height + 1) / 2 * HEIGHTS), 0), HEIGHTS - 1)
    face, largest = 0, abs(a[0])
    for n in range(1, 3):
        if abs(a[n]) > largest:
            face, largest = n, abs(a[n])
    u, v = a[(face + 1) % 3] / largest, a[(face + 2) % 3] / largest
    if a[face] < 0:
        face += 3
    m = min(int((u + 1) / 2 * SIDES), SIDES - 1)
    n = min(int((v + 1) / 2 * SIDES), SIDES - 1)
    # Roll: the angle of c from the horizontal direction across a, or from y where a is steep.
    ex, ey = -a[1], a[0]
    if abs(a[2]) > 0.8:
        ex, ey = 0.0, 1.0
    dot = ex * a[0] + ey * a[1]
    x, y, z = ex - dot * a[0], ey - dot * a[1], -dot * a[2]
    px, py, pz = a[1] * z - a[2] * y, a[2] * x - a[0] * z, a[0] * y - a[1] * x
    roll = math.atan2(c[0] * px + c[1] * py + c[2] * pz, c[0] * x + c[1] * y + c[2] * z)
    r = min(int((roll / (2 * math.pi) + 0.5) * ROLLS), ROLLS - 1)
    at = ((i * HEIGHTS + k) * DIRECTIONS + (face * SIDES + m) * SIDES + n) * ROLLS + r
    if turns:
        return at
    return at * AZIMUTHS + min(int((azimuth / (2 * math.pi) + 0.5) * AZIMUTHS), AZIMUTHS - 1)


@compiled
def _feature(reach: ReachMap, T: F64, out: F64) -> float:
    """Distance, height, approach and closing axis (8,) of a TCP pose (3, 4), base frame, turned to the front.

    Returns the azimuth by which it was turned; the first number is above 1 where the wrist is out of the map.
    """
    w, axis = reach.tcp_wrist_m, reach.axis_xy_m
    x = T[0, 0] * w[0] + T[0, 1] * w[1] + T[0, 2] * w[2] + T[0, 3] - axis[0]
    y = T[1, 0] * w[0] + T[1, 1] * w[1] + T[1, 2] * w[2] + T[1, 3] - axis[1]
    z = T[2, 0] * w[0] + T[2, 1] * w[1] + T[2, 2] * w[2] + T[2, 3]
    azimuth = math.atan2(y, x)
    c, s = math.cos(azimuth), math.sin(azimuth)
    out[0], out[1] = math.sqrt(x * x + y * y) / reach.half_m, z / reach.half_m
    for k in range(2):  # approach, closing axis
        a, b = T[0, 2 - k], T[1, 2 - k]
        out[2 + 3 * k], out[3 + 3 * k], out[4 + 3 * k] = c * a + s * b, c * b - s * a, T[2, 2 - k]
    return azimuth


@compiled
def _is_out(distance: float, height: float) -> bool:
    return distance > 1 + 1 / DISTANCES or abs(height) > 1 + 2 / HEIGHTS


@compiled
def cells_near(reach: ReachMap, T: F64, cells: Ints, feature: F64) -> float:
    """The cell of a TCP pose (3, 4) in the base frame and the six next to it, (7,); -1 where there is none.

    Returns the azimuth by which the hand was turned to the front.
    """
    azimuth = _feature(reach, T, feature)
    turns = reach.turn >= 0
    for k in range(7):
        cells[k] = -1
    distance, height = feature[0], feature[1]
    if _is_out(distance, height):
        return azimuth
    a, c = feature[2:5], feature[5:8]
    cells[0] = cell_of(distance, height, azimuth, a, c, turns)
    step = ROLLS * DIRECTIONS * (1 if turns else AZIMUTHS)
    per = 1 if turns else AZIMUTHS
    i, k, r = cells[0] // (step * HEIGHTS), cells[0] // step % HEIGHTS, cells[0] // per % ROLLS
    if i > 0:
        cells[1] = cells[0] - step * HEIGHTS
    if i < DISTANCES - 1:
        cells[2] = cells[0] + step * HEIGHTS
    if k > 0:
        cells[3] = cells[0] - step
    if k < HEIGHTS - 1:
        cells[4] = cells[0] + step
    cells[5] = cells[0] + per * ((r + 1) % ROLLS - r)
    cells[6] = cells[0] + per * ((r - 1) % ROLLS - r)
    return azimuth


@compiled
def score(reach: ReachMap, T: F64, w: ReachWork) -> int:
    """How many samples lie near a TCP pose (3, 4), base frame: those of its own cell count eight times."""
    azimuth, f = _feature(reach, T, w.feature), w.feature
    if _is_out(f[0], f[1]):
        return 0
    return int(reach.near[cell_of(f[0], f[1], azimuth, f[2:5], f[5:8], reach.turn >= 0)])


@compiled
def seeds(reach: ReachMap, tree: KinematicTree, T: F64, out: F64, w: ReachWork) -> int:
    """Joint vectors (S, A) of samples near a TCP pose (3, 4) that differ from each other; how many there are.

    Each further one is the first that differs from those before by 1 in some coordinate, or where there is
    none the one that differs most.
    """
    cells, near, gap, lower, upper = w.cells, w.near, w.gap, tree.lower, tree.upper
    azimuth = cells_near(reach, T, cells, w.feature)
    count, n = out.shape[1], 0
    for k in range(7):
        if cells[k] < 0 or n == len(near):
            continue
        for row in range(reach.first[cells[k]], reach.first[cells[k] + 1]):
            if n == len(near):
                break
            for m in range(count):
                x = reach.q[row, m]
                if m == reach.turn:
                    x += azimuth
                    x -= 2 * math.pi * math.floor((x - one_turn(lower[m], upper[m])[0]) / (2 * math.pi))
                near[n, m] = min(max(x, lower[m]), upper[m])
            gap[n] = np.inf
            n += 1
    found, best = min(n, len(out)), 0
    for s in range(found):
        for m in range(count):
            out[s, m] = near[best, m]
        last, best = best, 0
        most = -1.0
        for k in range(n):
            apart = 0.0
            for m in range(count):
                apart = max(apart, abs(near[k, m] - near[last, m]))
            gap[k] = min(gap[k], apart)
            if min(gap[k], _APART) > most:
                most, best = min(gap[k], _APART), k
    return found


@compiled
def _fill(reach: ReachMap, tree: KinematicTree, q: F64, cell: Ints, features: F64) -> None:
    """Cells (N,) and features (N, 8) of joint vectors (N, A), which are turned to the front in place."""
    joints, T, root = np.empty((len(tree.parent), 3, 4)), np.empty((3, 4)), np.zeros((3, 4))
    root[0, 0] = root[1, 1] = root[2, 2] = 1.0
    for k in range(len(q)):
        joint_poses(tree, root, q[k], joints)
        tcp_pose(tree, root, joints, T)
        f = features[k]
        azimuth = _feature(reach, T, f)
        cell[k] = cell_of(f[0], f[1], azimuth, f[2:5], f[5:8], reach.turn >= 0)
        if reach.turn >= 0:
            q[k, reach.turn] -= azimuth


def reach_map(tree: KinematicTree, draw: int = 0) -> ReachMap:
    """Where the hand of a tree, whose axes are z, can be. Trees that differ by scale alone share samples.

    `draw` seeds the samples.
    """
    length_m = float(np.linalg.norm(tree.T_parent_joint[:, :3, 3], axis=1).sum())
    turn, axis_xy_m = _upright(tree)
    unit = np.ones(len(tree.lower))
    unit[tree.coordinate[tree.slides]] = length_m
    one = _in_units(tree, length_m, unit)
    key = (*(a.tobytes() for a in one), turn, draw)
    if key not in _known:
        kept = sha256(repr((code_folder().name, np.__version__, _SAMPLES, _FIRST_SAMPLES, key)).encode())
        axis_xy = _rounded(axis_xy_m / length_m)
        stored = _MAPS.computed(kept.hexdigest(), lambda: _samples(one, turn, axis_xy, draw))
        count = DISTANCES * HEIGHTS * DIRECTIONS * ROLLS * (1 if turn >= 0 else AZIMUTHS)
        first = np.append(0, np.cumsum(np.bincount(stored["cell"], minlength=count))).astype(np.int32)
        _known[key] = first, stored["q"], float(stored["half"]), _near(first)
    _known.move_to_end(key)
    if len(_known) > _MAPS_KEPT:
        _known.popitem(last=False)
    first, q, half, near = _known[key]
    if (unit != 1.0).any():
        q = (q * unit).astype(np.float32)
    R, t_m = tree.T_joint_frame[-1, :3, :3], tree.T_joint_frame[-1, :3, 3]
    return ReachMap(first, q, axis_xy_m, turn, -(R.T @ t_m), half * length_m, near)


_known: OrderedDict[tuple[object, ...], tuple[I32, F32, float, I32]] = OrderedDict()


def _rounded(values: F64) -> F64:
    return np.round(values, _DIGITS) + 0.0  # no negative zero


def _in_units(tree: KinematicTree, length_m: float, unit: F64) -> KinematicTree:
    """The tree with its length as unit, its wrist as TCP, rounded: equal for scaled copies of an arm."""
    T, T_wrist = tree.T_parent_joint.copy(), tree.T_joint_frame[-1:].copy()
    T[:, :3, 3] /= length_m
    T_wrist[:, :3, 3] = 0.0
    return tree._replace(
        T_parent_joint=_rounded(T),
        offset=_rounded(np.where(tree.slides, tree.offset / length_m, tree.offset)),
        lower=_rounded(tree.lower / unit),
        upper=_rounded(tree.upper / unit),
        frame_joint=tree.frame_joint[-1:],
        T_joint_frame=_rounded(T_wrist),
    )


def _samples(one: KinematicTree, turn: int, axis_xy: F64, draw: int) -> Arrays:
    """Cells (N,) in their order, joint vectors `q` (N, A), half the map's width, in the tree's units."""
    rng = np.random.Generator(np.random.PCG64(draw))
    low, high = np.transpose([one_turn(*limits) for limits in zip(one.lower, one.upper, strict=True)])
    q = rng.uniform(low, high, (_SAMPLES, len(low)))
    cell, features = np.empty(len(q), np.int64), np.empty((len(q), 8))
    reach = ReachMap(
        np.zeros(1, np.int32),
        q[:0].astype(np.float32),
        axis_xy,
        turn,
        np.zeros(3),
        1.0,
        cell[:0].astype(np.int32),
    )
    tree, some = in_memory(one), q[:_FIRST_SAMPLES].copy()
    _fill(in_memory(reach), tree, some, cell[: len(some)], features)
    half = 1.02 * float(np.abs(features[: len(some), :2]).max())
    _fill(in_memory(reach._replace(half_m=half)), tree, q, cell, features)
    order = np.argsort(cell, kind="stable")
    return {"cell": cell[order].astype(np.int32), "q": q[order].astype(np.float32), "half": np.array(half)}


def _near(first: I32) -> I32:
    """Samples in each cell, eight times, and in those next to it in distance, height and roll (C,)."""
    count = np.diff(first).reshape(DISTANCES, HEIGHTS, DIRECTIONS, ROLLS, -1)
    near = 8 * count + np.roll(count, 1, axis=3) + np.roll(count, -1, axis=3)
    near[1:] += count[:-1]
    near[:-1] += count[1:]
    near[:, 1:] += count[:, :-1]
    near[:, :-1] += count[:, 1:]
    return near.ravel()


def _upright(tree: KinematicTree) -> tuple[int, F64]:
    """The coordinate of the first joint that turns, if about a vertical axis, and that axis's x and y (2,).

    Joints below it may slide up and down; -1 where there is none.
    """
    T = np.eye(4)
    for j in reversed(tree.hand_joints()):
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
