"""Geometry derived from a mesh: convex parts, flat tops, outlines of floors."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from datagen.workers.furniture.assets import Rectangle
from datagen.workers.geometry.mesh import F32, F64, Mesh, vertex_components

MAX_PARTS = 32
_MAX_CORNERS = 64
_MAX_POINTS = 20_000  # more on one circle take qhull minutes: they are rounded to _THINNEST_M
_THINNEST_M = 0.004
_CELL_M = 0.02
_MAX_CELLS = 250


def normals_and_areas(mesh: Mesh) -> tuple[F64, F64]:
    """Unit normals (F, 3) and areas (F,) of the faces."""
    corners = mesh.vertices_m[mesh.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-12)[:, None], length / 2


def face_components(faces: npt.NDArray[np.int32], vertex_count: int) -> npt.NDArray[np.int32]:
    """The connected component of each face (F,), by shared vertices."""
    labels = vertex_components(faces, vertex_count)
    return np.unique(labels[faces[:, 0]], return_inverse=True)[1].astype(np.int32)


def convex_parts(mesh: Mesh) -> tuple[F32, ...]:
    """Convex hulls of the connected components, the 32 largest at most."""
    labels = face_components(mesh.faces, len(mesh.vertices_m))
    groups = [np.unique(mesh.faces[labels == k]) for k in range(min(int(labels.max()) + 1, 4096))]
    points = [mesh.vertices_m[g].astype(np.float64) for g in groups]
    points.sort(key=lambda p: -float(np.prod(np.ptp(p, axis=0) + _THINNEST_M)))
    # Smaller components are screws, knobs and the like. They are dropped: one hull each would cost
    # time, and one hull for all would span the whole body.
    return tuple(hull_of(p) for p in points[:MAX_PARTS])


def hull_of(points_m: F64) -> F32:
    """Corners (V, 3) of the convex hull, thickened where the points are flat, at most 64 of them."""
    size = np.ptp(points_m, axis=0)
    if size.min() < _THINNEST_M:
        grow = np.where(size < _THINNEST_M, _THINNEST_M / 2, 0.0)
        points_m = np.concatenate([points_m - grow, points_m + grow])
    if len(points_m) > _MAX_POINTS:
        points_m = _THINNEST_M * np.unique(np.round(points_m / _THINNEST_M), axis=0)
    try:
        corners = points_m[ConvexHull(points_m).vertices]
    except QhullError:  # flat in a slanted plane: its bounding box has volume
        low, high = points_m.min(0) - _THINNEST_M / 2, points_m.max(0) + _THINNEST_M / 2
        corners = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        )
    if len(corners) > _MAX_CORNERS:
        picked = np.unique(np.argmax(_directions(_MAX_CORNERS) @ corners.T, axis=1))
        corners = corners[picked]
    return corners.astype(np.float32)


def _directions(count: int) -> F64:
    """Unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)


def slab_parts(mesh: Mesh, thickness_m: float, below_m: float) -> tuple[F32, ...]:
    """One thin prism per triangle, behind its face: exact for walls and floors with holes.

    Triangles that lie wholly above `below_m`, or have no area, are left out.
    """
    normals, areas = normals_and_areas(mesh)
    corners = mesh.vertices_m[mesh.faces].astype(np.float64)
    keep = (areas > 1e-4) & (corners[:, :, 2].min(1) < below_m)
    behind = corners[keep] - thickness_m * normals[keep][:, None]
    return tuple(np.concatenate([corners[keep], behind], axis=1).astype(np.float32))


def flat_tops(mesh: Mesh, low_m: float, high_m: float) -> list[tuple[float, Rectangle]]:
    """(height, rectangle) of the largest flat tops of a body in its own frame, z up: at most two.

    Upward faces are grouped by height; the largest rectangle of each level is found on a 2 cm
    raster. Only rectangles of at least 0.3 x 0.3 m count.
    """
    normals, areas = normals_and_areas(mesh)
    corners = mesh.vertices_m[mesh.faces].astype(np.float64)
    heights = corners[:, :, 2].mean(1)
    up = (normals[:, 2] > 0.97) & (heights > low_m) & (heights < high_m)
    levels: dict[int, float] = defaultdict(float)
    for height, area in zip(heights[up], areas[up], strict=True):
        levels[round(height / 0.02)] += area
    best = sorted(levels, key=lambda k: -levels[k])[:3]
    out: list[tuple[float, Rectangle]] = []
    for level in best:
        members = up & (np.abs(heights / 0.02 - level) <= 1.0)
        height = float(corners[members][:, :, 2].max())
        rectangle = _largest_rectangle(corners[members][:, :, :2])
        if rectangle is not None and all(abs(height - h) > 0.05 for h, _ in out):
            out.append((height, rectangle))
    return out[:2]


def _largest_rectangle(triangles: F64) -> Rectangle | None:
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    cell = max(_CELL_M, float((high - low).max()) / _MAX_CELLS)
    counts = np.maximum(((high - low) / cell).astype(int), 1)
    xs = low[0] + (np.arange(counts[0]) + 0.5) * cell
    ys = low[1] + (np.arange(counts[1]) + 0.5) * cell
    covered = np.zeros((len(xs), len(ys)), np.bool_)
    for a, b, c in triangles[:5000]:
        x = slice(*np.searchsorted(xs, [min(a[0], b[0], c[0]), max(a[0], b[0], c[0])]))
        y = slice(*np.searchsorted(ys, [min(a[1], b[1], c[1]), max(a[1], b[1], c[1])]))
        gx, gy = xs[x, None], ys[None, y]
        sides = [
            (q[0] - p[0]) * (gy - p[1]) - (q[1] - p[1]) * (gx - p[0]) for p, q in ((a, b), (b, c), (c, a))
        ]
        covered[x, y] |= (np.min(sides, axis=0) >= -1e-9) | (np.max(sides, axis=0) <= 1e-9)
    x0, x1, y0, y1 = _largest_block(covered)
    if (x1 - x0) * cell < 0.3 or (y1 - y0) * cell < 0.3:
        return None
    return Rectangle(
        (float(low[0] + x0 * cell), float(low[0] + x1 * cell)),
        (float(low[1] + y0 * cell), float(low[1] + y1 * cell)),
    )


def _largest_block(mask: npt.NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """The largest all-true block [x0, x1) x [y0, y1), by a stack of rising columns for every row."""
    best, block = 0, (0, 0, 0, 0)
    run = np.zeros(mask.shape[1], int)
    for x in range(mask.shape[0]):
        run = np.where(mask[x], run + 1, 0)
        stack: list[tuple[int, int]] = []
        for y, height in enumerate([*run.tolist(), 0]):
            start = y
            while stack and stack[-1][1] >= height:
                start, tall = stack.pop()
                if tall * (y - start) > best:
                    best, block = tall * (y - start), (x + 1 - tall, x + 1, start, y)
            stack.append((start, height))
    return block


def outlines(mesh: Mesh, members: npt.NDArray[np.bool_]) -> list[F64]:
    """Outer boundaries (K, 2) of the connected patches of some faces, seen from above."""
    faces = mesh.faces[members]
    if not len(faces):
        return []
    labels = face_components(faces, len(mesh.vertices_m))
    out: list[F64] = []
    for k in range(int(labels.max()) + 1):
        patch = faces[labels == k]
        edges = np.concatenate([patch[:, [0, 1]], patch[:, [1, 2]], patch[:, [2, 0]]])
        pairs = {(int(a), int(b)) for a, b in edges}
        following = {a: b for a, b in pairs if (b, a) not in pairs}
        loops = [mesh.vertices_m[loop][:, :2].astype(np.float64) for loop in _loops(following)]
        if loops:
            out.append(max(loops, key=lambda p: float(np.prod(np.ptp(p, axis=0)))))
    return out


def _loops(following: dict[int, int]) -> list[list[int]]:
    out: list[list[int]] = []
    while following:
        start, here = following.popitem()
        loop = [start]
        while here != start and here in following:
            loop.append(here)
            here = following.pop(here)
        if here == start and len(loop) >= 3:
            out.append(loop)
    return out
