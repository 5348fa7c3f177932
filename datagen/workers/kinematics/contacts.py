"""Distances and contacts of convex parts, compiled: boxes first, then GJK (Gilbert, Johnson, Keerthi 1988).

Every answer is exact: boxes only prove that parts are apart, and GJK stops as soon as its lower or its upper
bound of the distance decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.kinematics.compiler import compiled, constant, struct
from datagen.workers.kinematics.gjk import gap_m
from datagen.workers.kinematics.tree import Bools, Ints

_ONE_SHAPE, _NOTHING, _NONE = constant(0), constant(0), constant(-1)


class Parts(NamedTuple):
    """P convex parts in S shapes, one after the other; boxes along the axes of their owners' frames."""

    points_m: F64  # (S * V, 3), corners of all parts
    first: Ints  # (P + 1,), rows of each part's corners in the first shape
    owner: Ints  # (P,)
    center_m: F64  # (S * P, 3)
    half_m: F64  # (S * P, 3)
    touches: Ints  # (P,), kinds of still parts that each may touch


struct(Parts)


def parts_of(parts_by_owner: Sequence[Sequence[F32 | F64]], touches: Sequence[int] | None = None) -> Parts:
    """Parts of owners 0, 1, ..., each (V, 3) in its owner's frame."""
    parts = [np.asarray(p, np.float64) for parts in parts_by_owner for p in parts]
    owner = [k for k, parts in enumerate(parts_by_owner) for _ in parts]
    low = np.array([p.min(axis=0) for p in parts]).reshape(-1, 3)
    high = np.array([p.max(axis=0) for p in parts]).reshape(-1, 3)
    may_touch = np.zeros(len(parts), np.int64) if touches is None else np.array(touches, np.int64)[owner]
    points = np.concatenate([np.zeros((0, 3)), *parts])
    first = np.cumsum([0, *map(len, parts)])
    return Parts(points, first, np.array(owner, np.int64), (low + high) / 2, (high - low) / 2, may_touch)


class Still(NamedTuple):
    """F convex parts that do not move, with their boxes along the frame's axes."""

    points_m: F64  # (V, 3)
    first: Ints  # (F + 1,)
    low_m: F64  # (F, 3)
    high_m: F64  # (F, 3)
    kind: Ints  # (F,), bits: what the part belongs to


struct(Still)


class Scratch(NamedTuple):
    """Arrays that checks of P moving and F still parts write into."""

    W: F64  # (11, 3)
    v: F64  # (3,)
    axes: F64  # (P, F, 3), a direction between each moving and each still part
    center_m: F64  # (P, 3), of the moving parts' boxes
    half_m: F64  # (P, 3)
    near: Ints  # (F,)
    relative: F64  # (3, 4)


new_scratch = struct(Scratch)


@compiled
def scratch_of(moving: int, still: int) -> Scratch:
    """Arrays for checks of numbers of moving and of still parts."""
    return new_scratch(
        np.empty((11, 3)),
        np.empty(3),
        np.zeros((moving, still, 3)),
        np.empty((moving, 3)),
        np.empty((moving, 3)),
        np.empty(still, np.int64),
        np.empty((3, 4)),
    )


@compiled
def _boxes(
    parts: Parts, shape: int, T: F64, margin_m: float, s: Scratch
) -> tuple[float, float, float, float, float, float]:
    """Boxes of the posed parts along the still parts' axes, grown by the margin; returns the box of all."""
    lx = ly = lz = np.inf
    hx = hy = hz = -np.inf
    owner, centers, halves, out_center, out_half = (
        parts.owner,
        parts.center_m,
        parts.half_m,
        s.center_m,
        s.half_m,
    )
    for p in range(len(owner)):
        row = shape * len(owner) + p
        M, c, h, center, half = T[owner[p]], centers[row], halves[row], out_center[p], out_half[p]
        for i in range(3):
            center[i] = M[i, 0] * c[0] + M[i, 1] * c[1] + M[i, 2] * c[2] + M[i, 3]
            half[i] = abs(M[i, 0]) * h[0] + abs(M[i, 1]) * h[1] + abs(M[i, 2]) * h[2] + margin_m
        lx, hx = min(lx, center[0] - half[0]), max(hx, center[0] + half[0])
        ly, hy = min(ly, center[1] - half[1]), max(hy, center[1] + half[1])
        lz, hz = min(lz, center[2] - half[2]), max(hz, center[2] + half[2])
    return lx, ly, lz, hx, hy, hz


@compiled
def _gap_of(
    parts: Parts, shape: int, T: F64, still: Still, p: int, f: int, near_m: float, far_m: float, s: Scratch
) -> float:
    first, rows = parts.first, still.first
    at = shape * first[-1]
    A = parts.points_m[at + first[p] : at + first[p + 1]]
    B = still.points_m[rows[f] : rows[f + 1]]
    return gap_m(A, T[parts.owner[p]], B, near_m, far_m, s.axes[p, f], s.W, s.v)


@compiled
def hits_still(
    parts: Parts, shape: int, T: F64, still: Still, rows: Ints, ignored: int, margin_m: float, s: Scratch
) -> bool:
    """Whether a part, its owner posed by T (O, 3, 4), comes within `margin_m` of a still part.

    Only still parts of `rows` count, and none with a bit of `ignored`.
    """
    lx, ly, lz, hx, hy, hz = _boxes(parts, shape, T, margin_m, s)
    count, lows, highs, kinds, near = 0, still.low_m, still.high_m, still.kind, s.near
    for n in range(len(rows)):
        f = rows[n]
        low, high = lows[f], highs[f]
        is_apart = (
            (lz > high[2]) | (hz < low[2]) | (lx > high[0]) | (hx < low[0]) | (ly > high[1]) | (hy < low[1])
        )
        near[count] = f
        count += not (is_apart or kinds[f] & ignored)
    if count == 0:
        return False
    owner, halves, touches, centers, wides = parts.owner, parts.half_m, parts.touches, s.center_m, s.half_m
    for p in range(len(owner)):
        M, h = T[owner[p]], halves[shape * len(owner) + p]
        cx, cy, cz = centers[p, 0], centers[p, 1], centers[p, 2]
        wx, wy, wz = wides[p, 0], wides[p, 1], wides[p, 2]
        for n in range(count):
            f = near[n]
            low, high = lows[f], highs[f]
            if cx - wx > high[0] or cx + wx < low[0] or cy - wy > high[1] or cy + wy < low[1]:
                continue
            if cz - wz > high[2] or cz + wz < low[2] or kinds[f] & touches[p]:
                continue
            # The still box along the moving part's own axes: this drops most pairs of long, tilted parts.
            mx, my, mz = (low[0] + high[0]) / 2 - cx, (low[1] + high[1]) / 2 - cy, (low[2] + high[2]) / 2 - cz
            ex, ey, ez = (high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2
            is_apart = False
            for i in range(3):
                away = abs(M[0, i] * mx + M[1, i] * my + M[2, i] * mz)
                size = abs(M[0, i]) * ex + abs(M[1, i]) * ey + abs(M[2, i]) * ez
                is_apart |= away > size + h[i] + margin_m
            if is_apart:
                continue
            if _gap_of(parts, shape, T, still, p, f, margin_m, margin_m, s) <= margin_m:
                return True
    return False


@compiled
def _relative(A: F64, B: F64, out: F64) -> None:
    """out = inverse(B) A for poses (3, 4)."""
    x, y, z = A[0, 3] - B[0, 3], A[1, 3] - B[1, 3], A[2, 3] - B[2, 3]
    for i in range(3):
        for k in range(3):
            out[i, k] = B[0, i] * A[0, k] + B[1, i] * A[1, k] + B[2, i] * A[2, k]
        out[i, 3] = B[0, i] * x + B[1, i] * y + B[2, i] * z


@compiled
def _place(parts: Parts, T: F64, s: Scratch) -> None:
    """The centres of the parts' boxes, their owners posed by T (O, 3, 4)."""
    owner, centers, placed = parts.owner, parts.center_m, s.center_m
    for p in range(len(owner)):
        M, c = T[owner[p]], centers[p]
        for i in range(3):
            placed[p, i] = M[i, 0] * c[0] + M[i, 1] * c[1] + M[i, 2] * c[2] + M[i, 3]


@compiled
def _pair_touches(parts: Parts, a: int, b: int, T: F64, axis: F64, s: Scratch) -> bool:
    """Whether two parts touch: by boxes, each along the axes of the other, then exactly."""
    owner, centers, halves, first, M = parts.owner, parts.center_m, parts.half_m, parts.first, s.relative
    _relative(T[owner[a]], T[owner[b]], M)
    c, h, low, half, m = centers[a], halves[a], centers[b], halves[b], s.v
    for i in range(3):
        m[i] = M[i, 0] * c[0] + M[i, 1] * c[1] + M[i, 2] * c[2] + M[i, 3] - low[i]
        size = abs(M[i, 0]) * h[0] + abs(M[i, 1]) * h[1] + abs(M[i, 2]) * h[2]
        if abs(m[i]) > size + half[i]:
            return False
    for i in range(3):
        away = abs(M[0, i] * m[0] + M[1, i] * m[1] + M[2, i] * m[2])
        size = abs(M[0, i]) * half[0] + abs(M[1, i]) * half[1] + abs(M[2, i]) * half[2]
        if away > size + h[i]:
            return False
    A = parts.points_m[first[a] : first[a + 1]]
    B = parts.points_m[first[b] : first[b + 1]]
    return gap_m(A, M, B, 0.0, 0.0, axis, s.W, s.v) <= 0.0


@compiled
def hits_itself(parts: Parts, pairs: Ints, T: F64, axes: F64, s: Scratch) -> bool:
    """Whether any pair (K, 2) of the parts touches, their owners posed by T (O, 3, 4).

    `axes` (K, 3) keeps a direction between each two parts; `s` is that of `own_scratch`.
    """
    _place(parts, T, s)
    placed, radii = s.center_m, s.half_m
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        x, y, z = placed[a, 0] - placed[b, 0], placed[a, 1] - placed[b, 1], placed[a, 2] - placed[b, 2]
        reach = radii[a, 0] + radii[b, 0]
        if x * x + y * y + z * z <= reach * reach and _pair_touches(parts, a, b, T, axes[k], s):
            return True
    return False


@compiled
def touching_pairs(parts: Parts, pairs: Ints, T: F64, s: Scratch, out: Bools) -> None:
    """Which pairs (K, 2) of the parts touch, into out (N, K), their owners posed by T (N, O, 3, 4)."""
    axis = np.empty(3)
    for n in range(len(T)):
        for k in range(len(pairs)):
            axis[0] = axis[1] = axis[2] = 0.0
            out[n, k] = _pair_touches(parts, pairs[k, 0], pairs[k, 1], T[n], axis, s)


@compiled
def smallest_gap_m(
    parts: Parts, shape: int, T: F64, still: Still, rows: Ints, nearest_only: bool, far_m: float, s: Scratch
) -> float:
    """The smallest distance of the parts, posed by T (O, 3, 4), to the still ones of `rows`, at most `far_m`.

    With `nearest_only` the distance of the two parts whose boxes are nearest: an upper bound.
    """
    best, bound = far_m, far_m * far_m
    one, other = _NONE, _NONE
    _boxes(parts, shape, T, 0.0, s)
    lows, highs, kinds, centers, halves = still.low_m, still.high_m, still.kind, s.center_m, s.half_m
    for p in range(len(parts.owner)):
        center, half = centers[p], halves[p]
        for n in range(len(rows)):
            f = rows[n]
            if kinds[f] & parts.touches[p]:
                continue
            squared = 0.0
            for i in range(3):
                apart = max(lows[f, i] - center[i], center[i] - highs[f, i]) - half[i]
                squared += max(apart, 0.0) ** 2
            if squared < bound:
                if nearest_only:
                    bound, one, other = squared, p, f
                else:
                    best = min(best, _gap_of(parts, shape, T, still, p, f, 0.0, best, s))
                    bound = best * best
    if one >= 0:
        best = min(best, _gap_of(parts, shape, T, still, one, other, 0.0, best, s))
    return best


@compiled
def hit_any(parts: Parts, T: F64, still: Still, rows: Ints) -> bool:
    """Whether the parts touch a still part of `rows` at any of the poses T (N, O, 3, 4) of their owners."""
    s = scratch_of(len(parts.owner), len(still.kind))
    for k in range(len(T)):
        if hits_still(parts, _ONE_SHAPE, T[k], still, rows, _NOTHING, 0.0, s):
            return True
    return False


@compiled
def own_scratch(parts: Parts) -> Scratch:
    """Arrays for contacts of the parts with each other; half sizes are radii around the boxes' centres."""
    s = scratch_of(len(parts.owner), _NOTHING)
    for p in range(len(parts.owner)):
        most = 0.0
        for v in range(parts.first[p], parts.first[p + 1]):
            squared = 0.0
            for i in range(3):
                squared += (parts.points_m[v, i] - parts.center_m[p, i]) ** 2
            most = max(most, squared)
        s.half_m[p, 0] = math.sqrt(most)
    return s
