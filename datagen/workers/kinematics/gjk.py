"""Distance of two convex hulls, compiled: GJK (Gilbert, Johnson, Keerthi 1988)."""

from __future__ import annotations

import math

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled

_MAX_STEPS = 100
_CONVERGED = 1e-12  # relative, of the squared distance
_TOUCHING = 1e-20  # squared distance (m^2) that counts as none


@compiled
def _closest(W: F64, n: int, v: F64) -> int:
    """Reduce a simplex of n points W (11, 3) to the face nearest to the origin; v is the nearest point.

    Returns the number of points kept; 4 where the origin is inside. By regions of Voronoi (Ericson 2005,
    chapter 5.1), in the order of the points. Rows 4 and more of W are scratch.
    """
    if n == 1:
        v[0], v[1], v[2] = W[0, 0], W[0, 1], W[0, 2]
        return 1
    if n == 2:
        return _closest_line(W, v)
    if n == 3:
        return _closest_triangle(W, v)
    # A tetrahedron: the nearest of the faces that the origin lies outside of.
    best = np.inf
    kept, face, u, count = W[4:7], W[7:10], W[10], 0
    is_outside = False
    for k in range(4):  # the face without point k
        rows = 0
        for m in range(4):
            if m != k:
                face[rows, 0], face[rows, 1], face[rows, 2] = W[m, 0], W[m, 1], W[m, 2]
                rows += 1
        ax, ay, az = face[1, 0] - face[0, 0], face[1, 1] - face[0, 1], face[1, 2] - face[0, 2]
        bx, by, bz = face[2, 0] - face[0, 0], face[2, 1] - face[0, 1], face[2, 2] - face[0, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        to_origin = -(nx * face[0, 0] + ny * face[0, 1] + nz * face[0, 2])
        to_other = nx * (W[k, 0] - face[0, 0]) + ny * (W[k, 1] - face[0, 1]) + nz * (W[k, 2] - face[0, 2])
        if to_origin * to_other > 0 and to_other != 0:
            continue
        is_outside = True
        m = _closest_triangle(face, u)
        squared = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
        if squared < best:
            best, count = squared, m
            v[0], v[1], v[2] = u[0], u[1], u[2]
            for i in range(m):
                kept[i, 0], kept[i, 1], kept[i, 2] = face[i, 0], face[i, 1], face[i, 2]
    if not is_outside:
        v[0] = v[1] = v[2] = 0.0
        return 4
    for i in range(count):
        W[i, 0], W[i, 1], W[i, 2] = kept[i, 0], kept[i, 1], kept[i, 2]
    return count


@compiled
def _closest_line(W: F64, v: F64) -> int:
    dx, dy, dz = W[1, 0] - W[0, 0], W[1, 1] - W[0, 1], W[1, 2] - W[0, 2]
    t = -(W[0, 0] * dx + W[0, 1] * dy + W[0, 2] * dz)
    d = dx * dx + dy * dy + dz * dz
    if t <= 0.0 or d == 0.0:
        v[0], v[1], v[2] = W[0, 0], W[0, 1], W[0, 2]
        return 1
    if t >= d:
        W[0, 0], W[0, 1], W[0, 2] = W[1, 0], W[1, 1], W[1, 2]
        v[0], v[1], v[2] = W[0, 0], W[0, 1], W[0, 2]
        return 1
    t /= d
    v[0], v[1], v[2] = W[0, 0] + t * dx, W[0, 1] + t * dy, W[0, 2] + t * dz
    return 2


@compiled
def _closest_triangle(W: F64, v: F64) -> int:
    ax, ay, az = W[0, 0], W[0, 1], W[0, 2]
    bx, by, bz = W[1, 0], W[1, 1], W[1, 2]
    cx, cy, cz = W[2, 0], W[2, 1], W[2, 2]
    abx, aby, abz = bx - ax, by - ay, bz - az
    acx, acy, acz = cx - ax, cy - ay, cz - az
    d1 = -(abx * ax + aby * ay + abz * az)
    d2 = -(acx * ax + acy * ay + acz * az)
    if d1 <= 0.0 and d2 <= 0.0:
        v[0], v[1], v[2] = ax, ay, az
        return 1
    d3 = -(abx * bx + aby * by + abz * bz)
    d4 = -(acx * bx + acy * by + acz * bz)
    if d3 >= 0.0 and d4 <= d3:
        W[0, 0], W[0, 1], W[0, 2] = bx, by, bz
        v[0], v[1], v[2] = bx, by, bz
        return 1
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        v[0], v[1], v[2] = ax + t * abx, ay + t * aby, az + t * abz
        return 2
    d5 = -(abx * cx + aby * cy + abz * cz)
    d6 = -(acx * cx + acy * cy + acz * cz)
    if d6 >= 0.0 and d5 <= d6:
        W[0, 0], W[0, 1], W[0, 2] = cx, cy, cz
        v[0], v[1], v[2] = cx, cy, cz
        return 1
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        W[1, 0], W[1, 1], W[1, 2] = cx, cy, cz
        v[0], v[1], v[2] = ax + t * acx, ay + t * acy, az + t * acz
        return 2
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        W[0, 0], W[0, 1], W[0, 2] = bx, by, bz
        W[1, 0], W[1, 1], W[1, 2] = cx, cy, cz
        v[0], v[1], v[2] = bx + t * (cx - bx), by + t * (cy - by), bz + t * (cz - bz)
        return 2
    # Inside: the foot of the perpendicular, by the plane's normal, which keeps more digits than weights.
    nx, ny, nz = aby * acz - abz * acy, abz * acx - abx * acz, abx * acy - aby * acx
    d = nx * nx + ny * ny + nz * nz
    t = (nx * ax + ny * ay + nz * az) / d
    v[0], v[1], v[2] = t * nx, t * ny, t * nz
    return 3


@compiled
def gap_m(A: F64, T: F64, B: F64, near_m: float, far_m: float, axis: F64, W: F64, v: F64) -> float:
    """Distance of the hulls of A (Va, 3), moved by the pose T (3, 4), and of B (Vb, 3).

    It stops early: a result of at most `near_m` is an upper bound, one above `far_m` a lower bound. `axis`
    (3,) is a direction from B to A to begin with, and is set to the last one; zeros are allowed. `W` (11, 3)
    and `v` (3,) are scratch.
    """
    v[0], v[1], v[2] = axis[0], axis[1], axis[2]
    squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if squared == 0.0:
        v[0] = T[0, 3] - B[0, 0]
        v[1], v[2] = T[1, 3] - B[0, 1], T[2, 3] - B[0, 2]
        squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        if squared == 0.0:
            v[0] = squared = 1.0
    n = 0
    for _ in range(_MAX_STEPS):
        # The corner of A farthest along -v, and that of B farthest along v.
        dx = T[0, 0] * v[0] + T[1, 0] * v[1] + T[2, 0] * v[2]
        dy = T[0, 1] * v[0] + T[1, 1] * v[1] + T[2, 1] * v[2]
        dz = T[0, 2] * v[0] + T[1, 2] * v[1] + T[2, 2] * v[2]
        a, least = 0, np.inf
        for k in range(len(A)):
            s = A[k, 0] * dx + A[k, 1] * dy + A[k, 2] * dz
            if s < least:
                a, least = k, s
        b, most = 0, -np.inf
        for k in range(len(B)):
            s = B[k, 0] * v[0] + B[k, 1] * v[1] + B[k, 2] * v[2]
            if s > most:
                b, most = k, s
        x = T[0, 0] * A[a, 0] + T[0, 1] * A[a, 1] + T[0, 2] * A[a, 2] + T[0, 3] - B[b, 0]
        y = T[1, 0] * A[a, 0] + T[1, 1] * A[a, 1] + T[1, 2] * A[a, 2] + T[1, 3] - B[b, 1]
        z = T[2, 0] * A[a, 0] + T[2, 1] * A[a, 1] + T[2, 2] * A[a, 2] + T[2, 3] - B[b, 2]
        along = v[0] * x + v[1] * y + v[2] * z
        if along > 0.0 and along * along > far_m * far_m * squared:
            axis[0], axis[1], axis[2] = v[0], v[1], v[2]
            return along / math.sqrt(squared)
        if n > 0:
            # No corner is nearer: v is the nearest point.
            if squared - along <= _CONVERGED * squared:
                break
            is_known = False
            for k in range(n):
                is_known |= W[k, 0] == x and W[k, 1] == y and W[k, 2] == z
            if is_known:
                break
        W[n, 0], W[n, 1], W[n, 2] = x, y, z
        n = _closest(W, n + 1, v)
        squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        if n == 4 or squared <= near_m * near_m or squared <= _TOUCHING:
            axis[0] = axis[1] = axis[2] = 0.0
            return 0.0 if squared <= _TOUCHING else math.sqrt(squared)
    axis[0], axis[1], axis[2] = v[0], v[1], v[2]
    return math.sqrt(squared)
