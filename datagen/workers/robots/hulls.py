"""Convex parts of links: hulls of collision meshes, reduced outwards to a few corners."""

# coal defines its names at import time, which type checkers do not see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import io
import itertools
import re
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import coal
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.content_cache import CacheFolder, version_of
from datagen.workers.extras import how_to_get
from datagen.workers.geometry.mesh import BOX_BITS, F32, F64, I32, transformed
from datagen.workers.geometry.planar import prism_corners, unit_circle
from datagen.workers.robots.gripper import Parts
from datagen.workers.robots.urdf import MOST, Shape

# PhysX on a GPU accepts hulls of at most 64 corners, and coal is faster on fewer.
MAX_CORNERS = 64
# Part of the cache's keys: raise it when the same mesh gets other hulls.
_VERSION = 2
_CACHE = CacheFolder("link-hulls", most_files=1024)  # about 3 KB each
_MAX_BYTES = 64 << 20
_FIX = "Correct the file, or install its package again"
_MISSING = "Correct the URDF; package://NAME is a folder NAME above it, or an installed package NAME"
_FORMATS = (".obj", ".stl", ".dae", ".glb")
_UNIT = re.compile(rb"""<unit\s[^>]*?\bmeter\s*=\s*["']\s*([0-9.eE+-]+)""")
_TAKEN_AT_ONCE = 4
_PUSHES = 50
_TOUCHING_M = 1e-6
_MOST_FACES, _SHEET_M, _FLAT_M, _LARGEST_M = 500_000, 0.0005, 5e-7, 20.0
_RING = unit_circle(16, 0.5)
# Faces, edges and corners of a cube.
_DIRECTIONS = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_DIRECTIONS = _DIRECTIONS[np.abs(_DIRECTIONS).sum(axis=1) > 0]
_DIRECTIONS = _DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
# Corners of the polyhedron whose faces touch the unit sphere in these directions.
_BALL = HalfspaceIntersection(np.column_stack([_DIRECTIONS, -np.ones(26)]), np.zeros(3)).intersections


def shape_parts(shape: Shape, scale: float, cuts_m: tuple[float, ...] = ()) -> Parts:
    """Corners (V, 3) each of convex bodies around a shape, in its link's frame, all lengths times `scale`.

    Boxes are exact; cylinders and spheres lie within prisms that touch them. A mesh gives one hull, or one
    for each slab between the heights `cuts_m` along its z axis. Raises InputError naming the mesh that is
    missing or broken, and a shape that is flat in single precision or larger than any robot.
    """
    if shape.size_m is not None:
        hulls = (_solid(shape.size_m),)
    else:
        assert shape.mesh is not None
        cuts = tuple(sorted(height / float(shape.scale[2]) for height in cuts_m))
        hulls = tuple(hull * shape.scale for hull in mesh_hulls(shape.mesh, cuts))
    T = shape.T_link_shape
    parts = tuple((transformed(hull, T) * scale).astype(np.float32) for hull in hulls)
    if any(map(_is_flat, parts)):
        fix = "Correct it, or leave its link out with arm.ignore"
        raise InputError(shape.path, shape.where, "has no volume", fix)
    size_m = max((float(np.ptp(part, axis=0).max()) for part in parts), default=0.0)
    if size_m > _LARGEST_M:
        fix = 'Give a mesh in millimetres scale="0.001 0.001 0.001", or leave its link out with arm.ignore'
        raise InputError(shape.path, shape.where, f"is {size_m:,.0f} m large", fix)
    return parts


def _is_flat(part: F32) -> bool:
    """Whether a part (V, 3) is so thin that it has no hull, or none after it is moved in single precision."""
    points = part.astype(np.float64) - part.mean(axis=0)
    if np.ptp(points @ np.linalg.svd(points, full_matrices=False)[2][2]) < _FLAT_M:
        return True
    try:
        ConvexHull(part)
    except (QhullError, ValueError):
        return True
    return False


def _solid(size_m: F64) -> F64:
    """Corners (V, 3) of a box, or of prisms around a cylinder (radius, length) or a sphere (radius)."""
    if len(size_m) == 3:
        return (BOX_BITS - 0.5) * size_m
    if len(size_m) == 1:
        return _BALL * size_m[0]
    ring = _RING * (size_m[0] / np.cos(np.pi / len(_RING)))
    return prism_corners(ring, -size_m[1] / 2, size_m[1] / 2)


@lru_cache(maxsize=512)
def mesh_hulls(path: Path, cuts_m: tuple[float, ...] = ()) -> tuple[F64, ...]:
    """Corners (V, 3), at most `MAX_CORNERS`, of convex bodies that contain the mesh between the cuts.

    They are kept in the cache folder, because a reader of meshes takes a second to import.
    """
    content = sha256(read_regular(path, _MAX_BYTES, _FIX if path.is_file() else _MISSING)).hexdigest()
    versions = _VERSION, version_of("scipy"), version_of("trimesh")
    key = sha256(repr((versions, content, path.suffix.lower(), cuts_m)).encode()).hexdigest()
    if (stored := _CACHE.load(key)) is not None:
        return tuple(np.split(stored["corners"], stored["cuts"]))
    hulls = _hulls_of(path, cuts_m)
    _CACHE.store(key, {"corners": np.concatenate(hulls), "cuts": np.cumsum([*map(len, hulls)])[:-1]})
    return hulls


def _hulls_of(path: Path, cuts_m: tuple[float, ...]) -> tuple[F64, ...]:
    points, edges = read_points(path)
    bounds = (-np.inf, *cuts_m, np.inf)
    try:
        return tuple(outer_hull(_slab(points, edges, low, high)) for low, high in itertools.pairwise(bounds))
    except (QhullError, ValueError):
        if cuts_m:
            z = f"it reaches from z = {points[:, 2].min():.4g} to {points[:, 2].max():.4g} in its units"
            problem = f"has no body between two of the cuts {cuts_m}: {z}"
            raise InputError(path, "", problem, "Correct arm.cuts_m, in metres") from None
    # A label or a marker: a sheet of no thickness gets one.
    thick = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2] * _SHEET_M
    try:
        return (outer_hull(np.concatenate([points - thick, points + thick])),)
    except (QhullError, ValueError) as error:
        raise _wrong(path, "has no extent") from error


def read_points(path: Path) -> tuple[F64, npt.NDArray[np.int64]]:
    """Vertices (V, 3) and edges (E, 2) of a mesh. Raises InputError naming the file."""
    # Imported here: collision bodies of objects do not need it.
    import trimesh

    data = read_regular(path, _MAX_BYTES, _FIX)
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=path.suffix.lower(), process=False)
        points = np.asarray(mesh.vertices, np.float64) * _unit_m(data, path)
        edges = np.asarray(mesh.edges, np.int64)
    except Exception as error:  # readers raise any for a broken mesh
        kind = path.suffix.lower()
        if isinstance(error, ImportError) and kind == ".dae":
            missing = error.name or "a reader"
            raise InputError(path, "", f"needs {missing} to be read", how_to_get("robots")) from None
        fix = _FIX if kind in _FORMATS else "Convert it to OBJ, STL, DAE or GLB"
        raise InputError(path, "", f"is not a mesh ({type(error).__name__})", fix) from error
    if len(edges) > 3 * _MOST_FACES:
        fix = f"Simplify it to {_MOST_FACES:,} faces, or leave its link out with arm.ignore"
        raise InputError(path, "", f"has {len(edges) // 3:,} faces", fix)
    if len(points) < 4 or not (np.abs(points) <= MOST).all():
        raise _wrong(path, f"has fewer than four corners, or one that is not within {MOST:,.0f} m")
    return points, edges


def _unit_m(data: bytes, path: Path) -> float:
    """Metres in a unit of the mesh: COLLADA states it, other formats are in metres."""
    found = _UNIT.search(data) if path.suffix.lower() == ".dae" else None
    return float(found[1]) if found else 1.0


def _slab(points: F64, edges: npt.NDArray[np.int64], low: float, high: float) -> F64:
    """The vertices between two heights and the points where edges cross them."""
    found = [points[(points[:, 2] >= low) & (points[:, 2] <= high)]]
    for height in (low, high):
        start, end = points[edges[:, 0]], points[edges[:, 1]]
        crosses = (start[:, 2] < height) != (end[:, 2] < height)
        start, end = start[crosses], end[crosses]
        share = (height - start[:, 2]) / (end[:, 2] - start[:, 2])
        found.append(start + share[:, None] * (end - start))
    return np.concatenate(found)


def outer_hull(points: F64) -> F64:
    """Corners (V, 3) of a polytope that contains all points; their hull itself where it has few corners.

    Takes the extreme points in 26 directions, then repeatedly the points farthest outside the hull of those
    taken, each over another face. Where points remain outside a face, its corners move along its normal until
    none remain.
    """
    hull = ConvexHull(points)
    if len(hull.vertices) <= MAX_CORNERS:
        return points[np.sort(hull.vertices)]
    points = points[np.sort(hull.vertices)]
    taken = np.unique((points @ _DIRECTIONS.T).argmax(axis=0))
    while len(taken) < MAX_CORNERS:
        outside = _outside(points, ConvexHull(points[taken]))
        furthest = outside.argmax(axis=0)[np.argsort(-outside.max(axis=0), kind="stable")]
        first = np.sort(np.unique(furthest, return_index=True)[1])
        taken = np.append(taken, furthest[first][: min(_TAKEN_AT_ONCE, MAX_CORNERS - len(taken))])
    corners = points[taken]
    for _ in range(_PUSHES):
        hull = ConvexHull(corners)
        outside = _outside(points, hull).max(axis=0)  # (F,)
        if outside.max() < _TOUCHING_M:
            break
        pushed = np.zeros_like(corners)
        # Faces with points farther outside overwrite the others.
        for face in np.argsort(outside):
            if outside[face] > 0.0:
                pushed[hull.simplices[face]] = hull.equations[face, :3] * outside[face]
        corners = corners + pushed
    middle = corners.mean(axis=0)
    faces = ConvexHull(corners).equations
    rest = ((points - middle) @ faces[:, :3].T / -(faces[:, :3] @ middle + faces[:, 3])).max()
    return middle + (corners - middle) * max(1.0, float(rest))


def hull_faces(corners_m: F32) -> tuple[I32, F64]:
    """Triangles (F, 3) of the hull of its corners (V, 3), wound outwards, and their unit normals (F, 3)."""
    hull = ConvexHull(corners_m)
    faces, normals = hull.simplices.astype(np.int32), hull.equations[:, :3]
    a, b, c = (corners_m[faces[:, k]] for k in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), normals) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces, normals


def polyhedron(corners_m: F32 | F64) -> Any:
    """The solid convex hull of corners (V, 3) that span a volume, as coal's shape."""
    points = coal.StdVec_Vec3s()
    points.extend(list(np.asarray(corners_m, np.float64)))
    return coal.ConvexBase.convexHull(points, False, "")


def _outside(points: F64, hull: ConvexHull) -> F64:
    """(N, F) distances of points to the planes of a hull's faces, positive outside."""
    return points @ hull.equations[:, :3].T + hull.equations[:, 3]


def _wrong(path: Path, problem: str) -> InputError:
    return InputError(path, "", problem, _FIX)
