"""Floors: checked polygons, cut into triangles, as thin slabs whose top is at z = 0."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datagen.workers.furniture.solids import ColouredSolid, Rgb, prism
from datagen.workers.geometry.mesh import F64

MAX_CORNERS = 64
FLOOR_THICKNESS_M = 0.05
_MIN_AREA_M2 = 0.05
_SAME_M = 1e-4


def clean_polygon(corners_m: F64) -> F64 | str:
    """The polygon (K, 2), counter-clockwise, without repeated or straight corners.

    If it is not the outline of a floor, a string that names the problem.
    """
    keep = np.linalg.norm(corners_m - np.roll(corners_m, 1, axis=0), axis=1) > _SAME_M
    points = corners_m[keep]
    if len(points) >= 3:
        before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
        turn = _cross(before, after)
        points = points[np.abs(turn) > 1e-9 + 1e-6 * np.linalg.norm(before, axis=1)]
    if len(points) < 3:
        return "fewer than three different corners"
    area_m2 = 0.5 * float(_cross(points, np.roll(points, -1, axis=0)).sum())
    if abs(area_m2) < _MIN_AREA_M2:
        return f"an area of {abs(area_m2):.4f} m2"
    points = points if area_m2 > 0 else points[::-1]
    return "edges that cross each other" if _crosses_itself(points) else points


def triangles(polygon_m: F64) -> list[tuple[int, int, int]]:
    """Corner indices of K - 2 triangles that fill a simple counter-clockwise polygon (ear clipping)."""
    ring = list(range(len(polygon_m)))
    out: list[tuple[int, int, int]] = []
    while len(ring) > 3:
        ear = next((i for i in range(len(ring)) if _is_ear(polygon_m, ring, i)), 0)
        out.append((ring[ear - 1], ring[ear], ring[(ear + 1) % len(ring)]))
        del ring[ear]
    out.append((ring[0], ring[1], ring[2]))
    return out


def floor_solids(polygon_m: F64, rgb: Rgb) -> list[ColouredSolid]:
    """Triangular slabs below z = 0 that fill the polygon."""
    slabs: list[ColouredSolid] = []
    for a, b, c in triangles(polygon_m):
        corners = polygon_m[[a, b, c]]
        if abs(float(_cross(corners[1] - corners[0], corners[2] - corners[0]))) < 1e-6:
            continue
        top = np.column_stack([corners, np.zeros(3)])
        slabs.append(prism(top - (0.0, 0.0, FLOOR_THICKNESS_M), top, rgb))
    return slabs


def _is_ear(polygon_m: F64, ring: list[int], i: int) -> bool:
    a, b, c = (polygon_m[ring[k % len(ring)]] for k in (i - 1, i, i + 1))
    if float(_cross(b - a, c - b)) <= 0:
        return False
    others = [k for k in ring if k not in (ring[i - 1], ring[i], ring[(i + 1) % len(ring)])]
    p = polygon_m[others]
    inside = (_cross(b - a, p - a) >= 0) & (_cross(c - b, p - b) >= 0) & (_cross(a - c, p - c) >= 0)
    return not inside.any()


def _crosses_itself(points: F64) -> bool:
    start, end = points, np.roll(points, -1, axis=0)
    along = (end - start)[:, None]
    left = _cross(along, start[None] - start[:, None])
    right = _cross(along, end[None] - start[:, None])
    straddles = (left * right < 0) & (np.abs(left) > 1e-9) & (np.abs(right) > 1e-9)
    return bool((straddles & straddles.T).any())


def _cross(a: F64, b: F64) -> npt.NDArray[np.float64]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
