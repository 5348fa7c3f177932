"""Convex parts of links: hulls of collision meshes, reduced outwards to a few corners."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from schemas.errors import InputError
from workers.geometry.mesh import F32, F64
from workers.robots.urdf import Shape

# PhysX on a GPU takes hulls of at most 64 corners, and coal is faster on fewer.
MAX_CORNERS = 64
_BOX_BITS = (np.arange(8)[:, None] >> np.arange(3)) & 1
# Faces, edges and corners of a cube: 26 directions from which a hull is cut first.
_DIRECTIONS = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_DIRECTIONS = _DIRECTIONS[np.abs(_DIRECTIONS).sum(axis=1) > 0]
_DIRECTIONS = _DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)


def shape_part(shape: Shape, scale: float) -> F32:
    """Corners (V, 3) of a convex body around a shape, in its link's frame, all lengths times `scale`.

    Boxes are exact. Raises InputError naming the mesh that is missing, broken or flat.
    """
    if shape.box_m is not None:
        corners = (_BOX_BITS - 0.5) * shape.box_m
    else:
        assert shape.mesh is not None
        corners = mesh_hull(shape.mesh) * shape.scale
    T = shape.T_link_shape
    return ((corners @ T[:3, :3].T + T[:3, 3]) * scale).astype(np.float32)


@lru_cache(maxsize=256)
def mesh_hull(path: Path) -> F64:
    """Corners (V, 3), at most `MAX_CORNERS`, of a convex body that contains the mesh's hull."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
        points = np.asarray(mesh.vertices, np.float64)
    except OSError as error:
        raise _wrong(path, f"cannot be read: {error.strerror or error}") from error
    # Broken meshes surface in the reader in all of these ways.
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise _wrong(path, f"is not a mesh ({type(error).__name__})") from error
    if len(points) < 4 or not np.isfinite(points).all():
        raise _wrong(path, "has fewer than four corners, or one that is not finite")
    try:
        return outer_hull(points)
    except QhullError as error:
        raise _wrong(path, "is flat") from error


def outer_hull(points: F64) -> F64:
    """Corners (V, 3) of a polytope of few faces that contains all points.

    Starts from the support planes in 26 directions. Then the corner that stands out furthest is cut off by
    the hull's own face that it violates most, until no more fit. The hull itself is returned where it
    has few corners already.
    """
    hull = ConvexHull(points)
    if len(hull.vertices) <= MAX_CORNERS:
        return points[np.sort(hull.vertices)]
    corners = points[hull.vertices]
    inside = corners.mean(axis=0)
    faces = hull.equations  # (F, 4): n . x + d <= 0 inside
    planes = np.column_stack([_DIRECTIONS, -(corners @ _DIRECTIONS.T).max(axis=0)])
    best = _meeting_points(planes, inside)
    while True:
        excess = best @ faces[:, :3].T + faces[:, 3]
        worst = int(excess.max(axis=1).argmax())
        planes = np.vstack([planes, faces[excess[worst].argmax()]])
        cut = _meeting_points(planes, inside)
        if len(cut) > MAX_CORNERS or excess[worst].max() < 1e-6:
            return best
        best = cut


def excess_m(corners: F64, points: F64) -> float:
    """How far the furthest of the corners (V, 3) stands out of the hull of the points (N, 3), at least.

    The distance to the face it violates most: a lower bound of the distance, equal to it over faces.
    """
    faces = ConvexHull(points).equations
    return float((corners @ faces[:, :3].T + faces[:, 3]).max())


def _meeting_points(planes: F64, inside: F64) -> F64:
    found = HalfspaceIntersection(planes, inside).intersections
    # Where more than three planes meet, the point is found once for each triple.
    hull = ConvexHull(found, qhull_options="Qt")
    points = found[np.sort(hull.vertices)]
    rounded = np.unique(np.round(points, 9), axis=0, return_index=True)[1]
    return points[np.sort(rounded)]


def _wrong(path: Path, problem: str) -> InputError:
    return InputError(path, "", problem, "Install mani_skill again, or mend the file")
