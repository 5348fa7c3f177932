"""Parametric solids: a painted surface and the exact convex parts that fill it.

Everything is in metres, z up. Lathes are regular prisms and frusta over `segments` sides, so a
solid is a polyhedron and its convex parts are that same polyhedron, not an approximation of it.
Radii are those of the corners.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from datagen.workers.geometry.mesh import F32, F64, Mesh, concatenate, transformed_parts

Rgb = tuple[int, int, int]
Indices = npt.NDArray[np.int64]
# From face centres (F, 3) and outward unit normals (F, 3) to colours (F, 3).
Paint = Callable[[F64, F64], npt.NDArray[np.generic]]
Profile = Sequence[tuple[float, float]]
_TUBE_SIDES = 12


@dataclass(frozen=True, eq=False)
class ParametricSolid:
    """A closed surface and convex parts, in one frame."""

    mesh: Mesh
    parts_m: tuple[F32, ...]


def plain(rgb: Rgb) -> Paint:
    """One colour."""
    return lambda centres, _: np.tile(np.array(rgb), (len(centres), 1))


def bands(levels: Sequence[tuple[float, Rgb]], axis: int = 2) -> Paint:
    """Colours by coordinate: each rgb applies up to its level, the last one also beyond."""
    edges = np.array([level for level, _ in levels[:-1]])
    colours = np.array([rgb for _, rgb in levels])
    return lambda centres, _: colours[np.searchsorted(edges, centres[:, axis])]


def checks(period_m: float, first: Rgb, second: Rgb) -> Paint:
    """Print-like patches: a deterministic two-colour pattern of about `period_m`."""

    def paint(centres: F64, normals: F64) -> npt.NDArray[np.generic]:
        cell = np.floor(centres / period_m + 0.25).astype(np.int64)
        odd = (cell @ np.array([1, 1, 1]) + (np.abs(normals[:, 0]) > 0.7)) % 2 == 1
        return np.where(odd[:, None], np.array(first), np.array(second))

    return paint


def label(body: Rgb, print_: Rgb, low_m: float, high_m: float, text: Rgb) -> Paint:
    """A body colour with a printed band between two heights, carrying blocks of a text colour."""

    def paint(centres: F64, normals: F64) -> npt.NDArray[np.generic]:
        z = centres[:, 2]
        side = np.abs(normals[:, 2]) < 0.7
        banded = side & (z > low_m) & (z < high_m)
        middle = banded & (np.abs(z - (low_m + high_m) / 2) < 0.18 * (high_m - low_m))
        around = np.floor(np.arctan2(centres[:, 1], centres[:, 0]) / 0.5).astype(np.int64) % 3 != 0
        out = np.where(banded[:, None], np.array(print_), np.array(body))
        return np.where((middle & around)[:, None], np.array(text), out)

    return paint


def faces_of_box(colours: Sequence[Rgb]) -> Paint:
    """Six colours in the order +x, -x, +y, -y, +z, -z."""
    table = np.array(colours)

    def paint(_: F64, normals: F64) -> npt.NDArray[np.generic]:
        axis = np.abs(normals).argmax(axis=1)
        negative = normals[np.arange(len(normals)), axis] < 0
        return table[2 * axis + negative]

    return paint


def block(size_m: tuple[float, float, float], paint: Paint, cells: int = 6) -> ParametricSolid:
    """A box about the origin, its sides cut into cells x cells squares to carry a print."""
    half = np.array(size_m) / 2
    ticks = np.linspace(-1, 1, cells + 1)
    points: list[F64] = []
    faces: list[Indices] = []
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    for axis in range(3):
        for sign in (1, -1):
            u, v = np.meshgrid(ticks, ticks, indexing="ij")
            side = np.empty((u.size, 3))
            side[:, axis] = sign
            side[:, (axis + 1) % 3] = u.ravel()
            side[:, (axis + 2) % 3] = v.ravel()
            faces.append((triangles if sign > 0 else triangles[:, ::-1]) + len(points) * u.size)
            points.append(side)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T
    all_faces = np.concatenate(faces)
    side, triangle = np.divmod(np.arange(len(all_faces)), len(triangles))
    squares = side * len(quads) + triangle % len(quads)
    return _painted(np.concatenate(points) * half, all_faces, squares, [signs * half], paint)


def lathe(profile_m: Profile, paint: Paint, segments: int = 32) -> ParametricSolid:
    """A solid of revolution about z from its outline (radius, height), bottom to top.

    The caps are flat; a radius of 0 makes a tip. Heights must not fall. Convex parts are the
    longest stretches of the outline that bulge outward.
    """
    outline = np.array(profile_m, np.float64)
    rings = _rings(outline, segments)
    vertices, faces, cells = _lathe_surface(rings, outline)
    parts = [rings[a : b + 1].reshape(-1, 3) for a, b in _bulging_runs(outline)]
    return _painted(vertices, faces, cells, parts, paint)


def vessel(outer_m: Profile, inner_m: Profile, paint: Paint, segments: int = 20) -> ParametricSolid:
    """An open vessel: outer outline foot to rim, inner outline floor to rim, both (radius, height).

    The outer outline has one point more, its foot; the others face the inner ones one by one, the
    first at the height of the floor. The parts are the bottom and one block for each segment of
    each stretch of wall; every side of a block is flat, so the parts are exact.
    """
    outer, inner = np.array(outer_m, np.float64), np.array(inner_m, np.float64)
    outer_rings, inner_rings = _rings(outer, segments), _rings(inner, segments)
    outline = np.concatenate([outer, inner[::-1]])
    vertices, faces, cells = _lathe_surface(np.concatenate([outer_rings, inner_rings[::-1]]), outline)
    parts: list[F64] = [outer_rings[:2].reshape(-1, 3)]
    for low in range(len(inner) - 1):
        for k in range(segments):
            pair = [k, (k + 1) % segments]
            stretch = (outer_rings[low + 1], outer_rings[low + 2], inner_rings[low], inner_rings[low + 1])
            parts.append(np.concatenate([ring[pair] for ring in stretch]))
    return _painted(vertices, faces, cells, parts, paint)


def tube(centres_m: F64, radii_m: F64, paint: Paint, flat: float = 1.0) -> ParametricSolid:
    """A bent bar: circles of `radii_m` (N,) around `centres_m` (N, 3), across the path.

    The path lies in a plane; `flat` is the section's size across that plane over its size in it.
    Each stretch between two circles is one convex part.
    """
    tangents: F64 = np.asarray(np.gradient(centres_m, axis=0), np.float64)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = _plane_normal(centres_m)
    across = np.cross(normal, tangents)
    angles = np.arange(_TUBE_SIDES) * (2 * np.pi / _TUBE_SIDES)
    rings: F64 = (
        centres_m[:, None]
        + radii_m[:, None, None] * np.cos(angles)[None, :, None] * across[:, None]
        + flat * radii_m[:, None, None] * np.sin(angles)[None, :, None] * normal
    )
    vertices, faces, cells = _lathe_surface(rings, np.stack([radii_m, radii_m], axis=1))
    parts = [np.concatenate([rings[i], rings[i + 1]]) for i in range(len(rings) - 1)]
    return _painted(vertices, faces, cells, parts, paint)


def moved(
    solid: ParametricSolid,
    offset_m: Sequence[float] = (0, 0, 0),
    turn: Sequence[float] = (0, 0, 0),
    scale: Sequence[float] = (1, 1, 1),
) -> ParametricSolid:
    """The solid scaled, then turned (rotation vector, radians), then shifted."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ np.diag(scale)
    T[:3, 3] = offset_m
    return ParametricSolid(solid.mesh.transformed(T), transformed_parts(solid.parts_m, T))


def joined(*solids: ParametricSolid) -> ParametricSolid:
    """Several solids as one object; they may overlap."""
    return ParametricSolid(
        concatenate([s.mesh for s in solids]), tuple(part for s in solids for part in s.parts_m)
    )


def _plane_normal(points_m: F64) -> F64:
    """The unit normal of the plane that a path lies in; a horizontal one for a straight path."""
    _, spread, axes = np.linalg.svd(points_m - points_m.mean(axis=0))
    if spread[1] < 1e-9 * spread[0]:
        sideways = np.cross(axes[0], [0.0, 0.0, 1.0] if abs(axes[0][2]) < 0.9 else [1.0, 0.0, 0.0])
        return sideways / np.linalg.norm(sideways)
    return axes[2]


def _rings(outline: F64, segments: int) -> F64:
    """(K, segments, 3) points of an outline (K, 2) turned about z."""
    angles = np.arange(segments) * (2 * np.pi / segments)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rings = np.empty((len(outline), segments, 3))
    rings[:, :, :2] = outline[:, 0, None, None] * circle
    rings[:, :, 2] = outline[:, 1, None]
    return rings


def _lathe_surface(rings: F64, outline: F64) -> tuple[F64, Indices, Indices]:
    """Sides between consecutive rings and flat caps, facing outward: vertices, faces and cells."""
    count, segments, _ = rings.shape
    k = np.arange(segments)
    after = (k + 1) % segments
    bottom, top, last = count * segments, count * segments + 1, (count - 1) * segments
    faces: list[Indices] = []
    cells: list[Indices] = []

    def add(i: int, *corners: Indices) -> None:
        faces.append(np.stack(corners, axis=1))
        cells.append(i * segments + k)

    for i in range(count - 1):
        a, b = i * segments + k, i * segments + after
        c, d = b + segments, a + segments
        if outline[i, 0] > 0:
            add(i, a, b, c)
        if outline[i + 1, 0] > 0:
            add(i, a, c, d)
    if outline[0, 0] > 0:
        add(count, after, k, np.full(segments, bottom))
    if outline[-1, 0] > 0:
        add(count + 1, last + k, last + after, np.full(segments, top))
    vertices = np.concatenate([rings.reshape(-1, 3), [rings[0].mean(axis=0), rings[-1].mean(axis=0)]])
    return vertices, np.concatenate(faces), np.concatenate(cells)


def _bulging_runs(outline: F64) -> list[tuple[int, int]]:
    """Maximal runs (first, last) of an outline over which the radius is a concave function of z."""
    runs: list[tuple[int, int]] = []
    start = 0
    for i in range(1, len(outline) - 1):
        before, after = outline[i] - outline[i - 1], outline[i + 1] - outline[i]
        if i > start and before[0] * after[1] - before[1] * after[0] < -1e-12:
            runs.append((start, i))
            start = i
    return [*runs, (start, len(outline) - 1)]


def _painted(
    vertices: F64, faces: Indices, cells: Indices, parts: Sequence[F64], paint: Paint
) -> ParametricSolid:
    """The painted solid; faces of one cell (two triangles of a quadrilateral) have one colour."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, of_face = np.unique(cells, return_inverse=True)
    weight = np.bincount(of_face)[:, None]
    centre, normal = np.zeros((2, len(weight), 3))
    np.add.at(centre, of_face, corners.mean(axis=1))
    np.add.at(normal, of_face, normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    colours = np.asarray(paint(centre / weight, normal)).astype(np.uint8)[of_face]
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.int32), colours)
    return ParametricSolid(
        mesh, tuple(part.astype(np.float32)[np.sort(ConvexHull(part).vertices)] for part in parts)
    )
