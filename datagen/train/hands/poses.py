"""Poses of a parallel hand at the target, and their clearances in the observed cloud.

A label is good where an arm reaches a grasp that is free in the scene. Free grasps can be found without an
arm: this module lays a grid of approach and closing directions over the target, moves the hand to where it
would grip, and measures clearances there, on the way in and on the way up. The model learns whether an arm
reaches a pose from a base (`hand_pooling.py`).

The target's unobserved back is a copy of its observed points, turned by half a turn about the vertical
through its centre, as in `observed_visibility`. Directions begin at the side from which the target was seen,
so that poses turn with the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from math import pi

import numpy as np
from scipy.spatial import KDTree

from datagen.train.hands.sizes import FRANKA, HandSize
from datagen.train.inputs import F32, F64, U8, Array, Bools, Ints

_WRIST_RADIUS_M = 0.05
_WAYS_M = (0.05, 0.1)  # back along the approach, and up

# Tilts of the approach from straight down, azimuths, and turns of the hand about it.
_DIRECTIONS = ((0, 1, 8), (20, 4, 4), (45, 8, 4), (70, 8, 4), (95, 8, 2))
_GRIPS = 6  # positions along the closing axis (middle, both walls) at two depths
_OPENS_M = 0.02  # how much wider than the target the hand opens
_PAD_HEIGHT_M = 0.011  # of a pad above the TCP, along the approach
_SUPPORT_GAP_M = 0.004  # distance kept from the plane that the target stands on
_TARGET_POINTS, _SHAPE_POINTS = 128, 256
_NEIGHBOURS = 9

# Distances to the nearest observed point, on grids around the target.
_AROUND_M, _CELL_M = 0.3, 0.01  # no arm is shorter: these points are in every robot's crop
_TARGET_AROUND_M, _TARGET_CELL_M = 0.12, 0.005
_BEYOND_M = 0.1  # clearance outside of a grid

N_MEASURES = 25
HAND_WIDTH = N_MEASURES + 9


@dataclass(frozen=True, eq=False)
class _Hands:
    """Hands at P poses in the frame in which the target was seen from +x."""

    tcp_m: F64  # (P, 3)
    approach: F64  # (P, 3)
    closing: F64  # (P, 3)
    opening_m: F64  # (P,)
    size: HandSize

    @property
    def across(self) -> F64:
        """The third axis (P, 3), along the pads' width."""
        return np.cross(self.closing, self.approach)

    def fingers(self) -> F64:
        """Spheres (P, 2, 4, 3) of both fingers."""
        side = (self.opening_m / 2 + self.size.finger_m / 2)[:, None, None, None] * np.array([1.0, -1.0])[
            :, None, None
        ]
        z = np.array(self.size.finger_z_m)[:, None] * self.approach[:, None, None]
        return self.tcp_m[:, None, None] + side * self.closing[:, None, None] + z

    def palm(self) -> F64:
        """Spheres (P, 10, 3) of the palm."""
        y, z = np.array(self.size.palm_yz_m).T[..., None]
        return self.tcp_m[:, None] + y * self.closing[:, None] + z * self.approach[:, None]

    def wrist(self) -> F64:
        """Spheres (P, 3, 3) of the wrist, which carries the hand."""
        return self.tcp_m[:, None] + np.array(self.size.wrist_z_m)[:, None] * self.approach[:, None]


def poses_of_clouds(
    points_m: F32, target_mask: Bools, n_points: Ints, count: int, hands: Sequence[HandSize] = ()
) -> F32:
    """`hand_poses` (S, count, HAND_WIDTH) of clouds (S, P, 3) with `n_points` (S,) valid first points.

    `hands` has each cloud's hand; without, all are Franka Hands.
    """
    found = np.zeros((len(n_points), count, HAND_WIDTH), np.float32)
    for row, n in enumerate(n_points):
        cloud_m, mask = points_m[row, :n], target_mask[row, :n]
        found[row] = hand_poses(cloud_m[~mask], cloud_m[mask], count, hands[row] if hands else FRANKA)
    return found


def hand_poses(others_m: F32, target_m: F32, count: int, size: HandSize = FRANKA) -> F32:
    """The `count` most promising poses (count, HAND_WIDTH), best first: measures, TCP, approach, closing.

    Points of other objects (M, 3) and of the target (T, 3) are in the target's frame, as are the poses. Rows
    are zero where no point of the target was observed, and beyond the number of directions.
    """
    found = np.zeros((count, HAND_WIDTH), np.float32)
    # NaN fails the comparisons.
    others, target = (
        m[np.linalg.norm(m, axis=1) <= _AROUND_M].astype(np.float64) for m in (others_m, target_m)
    )
    target = target[:_SHAPE_POINTS]
    if not len(target):
        return found
    seen_from = target[:_TARGET_POINTS, :2].mean(0)
    angle = float(np.arctan2(seen_from[1], seen_from[0])) if np.hypot(*seen_from) > 1e-4 else 0.0
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])  # from the frame in which the target is seen from +x
    measures, penalty, hands = _measured(others @ R, target @ R, size)
    best = np.argsort(penalty, kind="stable")[:count]
    axes = [v[best] @ R.T for v in (hands.tcp_m, hands.approach, hands.closing)]
    found[: len(best)] = np.concatenate([measures[best], *axes], axis=1)
    return found


def _measured(others_m: F64, target_m: F64, size: HandSize) -> tuple[F64, F64, _Hands]:
    """Measures (D, N_MEASURES), penalties (D,) and poses of the best grip of each direction."""
    turned = np.array([-1.0, -1.0, 1.0])
    half = target_m[:_TARGET_POINTS]
    points, whole = np.concatenate([half, half * turned]), np.concatenate([target_m, target_m * turned])
    normals = _normals(half)
    normals = np.concatenate([normals, normals * turned])
    support_m = float(whole[:, 2].min())
    frames = _frames()  # (D, 3 axes, 3)
    local = np.einsum("dij,nj->din", frames, points)
    facing = np.abs(frames[:, 1] @ normals.T)
    grips, low, high = _grips(local, frames[:, :, 2], support_m, size)

    offset = local[:, None] - grips[..., None]  # (D, 6, 3, N)
    x, y, z = offset[:, :, 0], offset[:, :, 1], offset[:, :, 2]
    between = (np.abs(x) < size.pad_m) & (z > -0.014) & (z < _PAD_HEIGHT_M)
    between &= np.abs(y) < round(size.stroke_m / 2 + 0.003, 6)
    held = between.sum(-1)
    spread = (np.abs(y) * between).max(-1) * 2
    width = np.maximum(np.where(between, y, -9).max(-1) - np.where(between, y, 9).min(-1), 0)
    wall = between & (np.abs(y) > spread[..., None] / 2 - 0.006)
    squareness = (facing[:, None] * wall).sum(-1) / np.maximum(wall.sum(-1), 1)
    depth = (z * between).sum(-1) / np.maximum(held, 1)

    tcp = np.einsum("dij,dki->dkj", frames, grips).reshape(-1, 3)
    axes = np.repeat(frames, _GRIPS, axis=0)
    opening = np.minimum(spread + _OPENS_M, size.stroke_m).ravel()
    hands = _Hands(tcp, axes[:, 2], axes[:, 1], opening, size)
    clear, own = _clearances(hands, others_m, whole)
    tips, palm = (h - support_m for h in _lowest(tcp[:, 2], axes[:, :, 2], opening, size))

    extent = np.repeat(high - low, _GRIPS, axis=0)  # (P, 3)
    numbers = [np.log1p(held.ravel()) / 3, 10 * width.ravel(), 10 * opening]
    numbers += [squareness.ravel(), 20 * depth.ravel()]
    numbers += [np.clip(20 * gap, -1, 1) for gap in clear] + [np.clip(40 * gap, -1, 1) for gap in own]
    numbers += [np.clip(40 * tips, -2, 2), np.clip(20 * palm, -2, 2), tips < 0.002]
    numbers += [10 * extent[:, 2], 10 * extent[:, 1], 20 * (tcp[:, 2] - support_m)]
    numbers += [20 * np.hypot(tcp[:, 0], tcp[:, 1])]
    numbers += [20 * (np.einsum("pi,pi->p", tcp, hands.approach) - np.repeat(low[:, 2], _GRIPS))]

    def short(gap: F64) -> F64:
        return np.maximum(0.005 - gap, 0) * 40

    penalty = (
        2.0 * (held.ravel() < 3) + 3.0 * (width.ravel() > size.stroke_m - 0.002) + 1 - squareness.ravel()
    )
    weights = (1.5, 1.5, 1.5, 0.5, 0.7, 0.7, 0.7, 0.7, 0.4, 0.4)
    penalty += sum(w * short(gap) for w, gap in zip(weights, clear, strict=True))
    penalty += short(own[0] + 0.004) + short(own[1]) + 2 * short(tips + 0.002) + 2 * short(palm + 0.002)
    best = np.arange(len(frames)) * _GRIPS + penalty.reshape(-1, _GRIPS).argmin(1)
    chosen = _Hands(hands.tcp_m[best], hands.approach[best], hands.closing[best], opening[best], size)
    return np.stack(numbers, axis=1)[best], penalty[best], chosen


@cache
def _frames() -> F64:
    """Axes (D, 3, 3) of the hand in every direction: across, closing, approach."""
    frames: list[F64] = []
    for tilt_deg, azimuths, turns in _DIRECTIONS:
        tilt, shift = np.deg2rad(tilt_deg), 0.5 if tilt_deg == 20 else 0.0
        for k in range(azimuths):
            a = 2 * pi * (k + shift) / azimuths
            approach = -np.array([np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)])
            level = np.array([-np.sin(a), np.cos(a), 0.0])
            for turn in np.arange(turns) * pi / turns:
                closing = np.cos(turn) * level + np.sin(turn) * np.cross(approach, level)
                frames.append(np.stack([np.cross(closing, approach), closing, approach]))
    return np.array(frames)


def _grips(local: F64, rise: F64, support_m: float, size: HandSize) -> tuple[F64, F64, F64]:
    """TCPs (D, 6, 3) in each direction's own axes, and the target's bounds (D, 3) there.

    `local` (D, 3, N) are the target's points, `rise` (D, 3) is the height gained along each axis.
    Grips are at the middle and at both walls, shallow and deep. A hand that would touch the support is moved
    back, or up along the pads' width.
    """
    low, high = local.min(2), local.max(2)
    positions = np.stack([(low[:, 1] + high[:, 1]) / 2, low[:, 1] + 0.004, high[:, 1] - 0.004], axis=1)
    across, up = rise[:, :1], rise[:, 2:]
    opening = np.minimum(high[:, 1:2] - low[:, 1:2] + _OPENS_M, size.stroke_m)
    deep = np.minimum(low[:, 2] + 0.032, (low[:, 2] + high[:, 2]) / 2 + 0.004)
    grips: list[F64] = []
    for depth in (low[:, 2] + 0.008, deep):
        z = np.repeat(depth[:, None], 3, axis=1)
        x = np.repeat(np.median(local[:, 0], axis=1)[:, None], 3, axis=1)

        def missing(x: F64, z: F64) -> F64:
            height = across * x + rise[:, 1:2] * positions + up * z
            lowest = np.minimum(*_lowest(height, rise[:, None], opening, size))
            return np.maximum(_SUPPORT_GAP_M - (lowest - support_m), 0)

        back = np.where(up < -0.3, missing(x, z) / np.maximum(-up, 0.3), 0)
        z = z - np.minimum(back, np.maximum(z - low[:, 2:] + 0.004, 0))
        aside = missing(x, z) / np.maximum(np.abs(across), 0.3) * np.sign(across)
        x = np.clip(
            x + np.where(np.abs(across) > 0.3, aside, 0),
            low[:, :1] + 0.004,
            np.maximum(high, low + 0.008)[:, :1] - 0.004,
        )
        grips.append(np.stack([x, positions, z], axis=2))
    return np.concatenate(grips, axis=1), low, high


def _lowest(tcp_height_m: F64, rise: F64, opening_m: F64, size: HandSize) -> tuple[F64, F64]:
    """Heights of the lowest corner of the fingertips and of the palm; `rise` (..., 3) as in `_grips`."""
    across, closing = np.abs(rise[..., 0]), np.abs(rise[..., 1])
    approach = rise[..., 2]
    tips = tcp_height_m - np.maximum(-approach * size.tip_m, 0) - across * 0.009
    tips = tips - closing * (opening_m / 2 + size.finger_m)
    palm = tcp_height_m + np.minimum(approach * size.palm_near_m, approach * size.palm_far_m)
    return tips, palm - across * size.palm_m[0] - closing * size.palm_m[1]


def _clearances(hands: _Hands, others_m: F64, target_m: F64) -> tuple[list[F64], list[F64]]:
    """Clearances (P,) each, from other objects and from the target.

    From others: nearer finger, other finger, palm, wrist; fingers, and palm, at two positions on the way in;
    all at two positions on the way up. From the target: fingers, palm.
    """
    fingers, palm, wrist = hands.fingers(), hands.palm(), hands.wrist()
    finger_m, palm_m = hands.size.finger_radius_m, hands.size.palm_radius_m
    others = partial(_around(others_m, _AROUND_M, _CELL_M), outside_m=_BEYOND_M)
    own = partial(_around(target_m, _TARGET_AROUND_M, _TARGET_CELL_M), outside_m=_BEYOND_M)
    each = others(fingers).min(2) - finger_m
    clear = [each.min(1), each.max(1), others(palm).min(1) - palm_m]
    clear.append(others(wrist).min(1) - _WRIST_RADIUS_M)
    both, up = fingers.reshape(len(palm), -1, 3), np.array([0.0, 0.0, 1.0])
    for way in _WAYS_M:
        back = -way * hands.approach[:, None]
        clear.append(others(both + back).min(1) - finger_m)
        clear.append(others(palm + back).min(1) - palm_m)
    for way in _WAYS_M:
        raised = others(both + way * up).min(1) - finger_m
        clear.append(np.minimum(raised, others(palm + way * up).min(1) - palm_m))
    return clear, [own(both).min(1) - finger_m, own(palm).min(1) - palm_m]


def _around(points_m: F64, half_m: float, cell_m: float) -> DistanceGrid:
    """Distances to points in a cube around the origin. Measures are clipped below its largest distance."""
    cells = round(2 * half_m / cell_m)
    return DistanceGrid(points_m, np.full(3, -half_m), (cells, cells, cells), cell_m)


def _normals(points_m: F64) -> F64:
    """Normals (N, 3), of either sign, of the planes of their neighbours; zero for fewer than four points."""
    if len(points_m) < 4:
        return np.zeros_like(points_m)
    _, row = KDTree(points_m).query(points_m, min(_NEIGHBOURS, len(points_m)))
    around = points_m[row] - points_m[row].mean(1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]


# In cells. The sum of two squares fits in a byte.
FARTHEST = 11


class DistanceGrid:
    """Distances (m) from cells to the nearest cell with a point, at most `FARTHEST` cells."""

    def __init__(self, points_m: Array, low_m: Array, shape: tuple[int, int, int], cell_m: float) -> None:
        """Points (M, 3) outside the box of `shape` cells with its corner at `low_m` (3,) are left out."""
        self._low_m, self._shape, self._cell_m = low_m, shape, cell_m
        cell, inside = self._cells(points_m[np.isfinite(points_m).all(1)])
        square = np.full(shape, FARTHEST**2, np.uint8)
        square[tuple(cell[inside].T)] = 0
        for axis in range(3):
            square = _nearer(square, axis)
        self._distance_m: F32 = np.sqrt(square.ravel(), dtype=np.float32) * np.float32(cell_m)

    def __call__(self, points_m: Array, outside_m: float) -> F32:
        """Distances (...) of points (..., 3); `outside_m` for those outside of the box."""
        cell, inside = self._cells(points_m)
        row = (cell[..., 0] * self._shape[1] + cell[..., 1]) * self._shape[2] + cell[..., 2]
        return np.where(inside, self._distance_m[np.where(inside, row, 0)], np.float32(outside_m))

    def _cells(self, points_m: Array) -> tuple[Ints, Bools]:
        cell = np.floor((points_m - self._low_m) / self._cell_m).astype(np.int32)
        x, y, z = np.moveaxis((cell >= 0) & (cell < self._shape), -1, 0)
        return cell, x & y & z


def _nearer(square: U8, axis: int) -> U8:
    """The least of a cell's squared distance and those of the cells along `axis`, plus their own squared.

    After all three axes it is the squared distance in space (Felzenszwalb and Huttenlocher 2012, without
    their envelope: few steps along a line of bytes cost less).
    """
    line = np.ascontiguousarray(np.moveaxis(square, axis, 0))  # a shift along the last axis is slow
    found, further = line.copy(), np.empty_like(line)
    for step in range(1, min(FARTHEST, len(line))):
        np.add(line, np.uint8(step * step), out=further)
        np.minimum(found[step:], further[:-step], out=found[step:])
        np.minimum(found[:-step], further[step:], out=found[:-step])
    return np.moveaxis(found, 0, axis)
