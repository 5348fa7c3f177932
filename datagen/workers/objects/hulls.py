"""Convex hulls: vertex reduction, surface samples, and distances from a union of hulls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, KDTree

from datagen.workers.geometry.mesh import F32, F64

_ROUNDING_M = 1e-6  # error of float32 vertices a few decimetres from the origin


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull with its often used properties; metres."""

    vertices_m: F64  # (V, 3), in lexicographic order
    faces_m: F64  # (F, 3, 3), corners
    planes: F64  # (F, 4), unit normals outward and offsets
    volume_m3: float
    low_m: F64  # (3,)
    high_m: F64  # (3,)


def hull_of(points_m: F32 | F64) -> Hull:
    """The hull of points (N, 3) that span a volume; bitwise independent of their order."""
    points = np.unique(np.asarray(points_m, np.float64), axis=0)
    hull = ConvexHull(points)
    vertices = points[np.sort(hull.vertices)]
    return Hull(
        vertices,
        points[hull.simplices],
        hull.equations,
        float(hull.volume),
        vertices.min(axis=0),
        vertices.max(axis=0),
    )


def bounds_m(hulls: Sequence[Hull]) -> tuple[F64, F64]:
    """Lowest and highest corner, (3,) each, of the box around hulls."""
    return np.min([h.low_m for h in hulls], axis=0), np.max([h.high_m for h in hulls], axis=0)


def extent_m(hulls: Sequence[Hull]) -> float:
    """Longest side of the box around hulls."""
    low, high = bounds_m(hulls)
    return float((high - low).max())


def few_vertices(vertices_m: F64, limit: int) -> F64:
    """At most `limit` (4 or more) of a hull's vertices (V, 3), whose hull approximates it.

    Starts from a tetrahedron and adds the vertex farthest outside the current hull.
    """
    if len(vertices_m) <= limit:
        return vertices_m
    chosen = _tetrahedron(vertices_m)
    hull = ConvexHull(vertices_m[chosen], incremental=True)
    while len(chosen) < limit:
        outside = (vertices_m @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
        outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
        hull.add_points(vertices_m[chosen[-1:]])
    hull.close()
    return vertices_m[np.sort(chosen)]


def _tetrahedron(points: F64) -> list[int]:
    """Rows of four points that span a volume: each is farthest from the previous point, line or plane."""
    first = int(points[:, 0].argmin())
    from_first = points - points[first]
    second = int(np.linalg.norm(from_first, axis=1).argmax())
    normals = np.cross(from_first, from_first[second])
    third = int(np.linalg.norm(normals, axis=1).argmax())
    fourth = int(np.abs(from_first @ normals[third]).argmax())
    return [first, second, third, fourth]


def surface_points_m(hull: Hull, step_m: float) -> F64:
    """Points (N, 3) on the faces of a hull: rows along each longest edge, at most `step_m` apart."""
    edges = np.roll(hull.faces_m, -1, axis=1) - hull.faces_m
    lengths = np.linalg.norm(edges, axis=2)  # (F, 3)
    faces, longest = np.arange(len(lengths)), lengths.argmax(axis=1)
    start, along = hull.faces_m[faces, longest], edges[faces, longest]
    to_apex = hull.faces_m[faces, (longest + 2) % 3] - start
    height = np.linalg.norm(np.cross(along, to_apex), axis=1) / lengths.max(axis=1)
    n_along = np.ceil(lengths.max(axis=1) / step_m).astype(int)
    n_up = np.maximum(1, np.ceil(height / step_m).astype(int))
    counts = (n_along + 1) * (n_up + 1)
    face = np.repeat(faces, counts)
    index = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    up, on = np.divmod(index, n_along[face] + 1)
    u, s = (up / n_up[face])[:, None], (on / n_along[face])[:, None]
    return start[face] + u * to_apex[face] + (1 - u) * s * along[face]


def distances_m(hulls: Sequence[Hull], points_m: F64, step_m: float, farthest_m: float = np.inf) -> F64:
    """Distances (N,) of the points (N, 3) from the union of hulls, 0 inside, at most `farthest_m`.

    Outside, it is the distance to the nearest surface sample: up to 0.8 of `step_m` too large.
    """
    outside = np.ones(len(points_m), bool)
    for hull in hulls:
        low_m, high_m = hull.low_m - _ROUNDING_M, hull.high_m + _ROUNDING_M
        near = outside & (points_m >= low_m).all(axis=1) & (points_m <= high_m).all(axis=1)
        rows = np.flatnonzero(near)
        beyond = (points_m[rows] @ hull.planes[:, :3].T + hull.planes[:, 3]).max(axis=1, initial=-np.inf)
        outside[rows[beyond <= _ROUNDING_M]] = False
    distances = np.zeros(len(points_m))
    if outside.any():
        surface = np.concatenate([surface_points_m(hull, step_m) for hull in hulls])
        found = KDTree(surface).query(points_m[outside], distance_upper_bound=farthest_m)[0]
        distances[outside] = np.minimum(found, farthest_m)
    return distances
