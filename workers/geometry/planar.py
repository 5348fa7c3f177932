"""Planar geometry of the floor: footprints, distances, containment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from workers.geometry.mesh import F64


def convex_hull(points_m: F64) -> F64:
    """Counter-clockwise convex hull (K, 2) of planar points (N, 2).

    Points on a line, which have no area, give their two ends.
    """
    points_m = np.asarray(points_m, np.float64)
    try:
        return points_m[ConvexHull(points_m).vertices]
    except QhullError:
        along = points_m - points_m[0]
        axis = along[np.argmax((along**2).sum(1))]
        order = np.argsort(along @ axis)
        return points_m[order[[0, -1]]]


def segment_distance(points_m: F64, start_m: F64, end_m: F64) -> F64:
    """Distance of points (N, 2) from segments `start_m`, `end_m` (S, 2), as (N, S)."""
    along = end_m - start_m
    rel = points_m[:, None, :] - start_m[None]
    length2 = np.maximum((along**2).sum(1), 1e-18)
    t = np.clip((rel * along).sum(2) / length2, 0.0, 1.0)
    return np.linalg.norm(rel - t[..., None] * along, axis=2)


def signed_distance_to_convex(points_m: F64, polygon_m: F64) -> F64:
    """Distance (N,) of points (N, 2) from a counter-clockwise convex polygon; negative inside."""
    end_m = np.roll(polygon_m, -1, axis=0)
    outside = segment_distance(points_m, polygon_m, end_m).min(1)
    if len(polygon_m) < 3:
        return outside
    along = end_m - polygon_m
    rel = points_m[:, None, :] - polygon_m[None]
    inside = (along[:, 0] * rel[..., 1] - along[:, 1] * rel[..., 0] >= 0).all(1)
    return np.where(inside, -outside, outside)


def inside_polygon(points_m: F64, polygon_m: F64) -> npt.NDArray[np.bool_]:
    """Whether points (N, 2) lie in a simple polygon (K, 2), by the even-odd rule."""
    x, y = points_m[:, None, 0], points_m[:, None, 1]
    start, end = polygon_m[None], np.roll(polygon_m, -1, axis=0)[None]
    spans = (start[..., 1] > y) != (end[..., 1] > y)
    rise = np.where(spans, end[..., 1] - start[..., 1], 1.0)
    crossing = start[..., 0] + (y - start[..., 1]) / rise * (end[..., 0] - start[..., 0])
    return (spans & (x < crossing)).sum(1) % 2 == 1


def inside_any(points_m: F64, polygons_m: Sequence[F64]) -> npt.NDArray[np.bool_]:
    """Whether points (N, 2) lie in at least one of the polygons."""
    inside = np.zeros(len(points_m), np.bool_)
    for polygon_m in polygons_m:
        inside |= inside_polygon(points_m, polygon_m)
    return inside
