"""Read one object of a folder: its surface upright and in metres, its convex parts and its mass."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects.convex import MAX_PARTS, ConvexParts, components, convex_parts, not_convex
from datagen.workers.objects.decomposition import closed_volume_m3, decompose, error_text
from datagen.workers.objects.descriptions import Description, Piece, read_description
from datagen.workers.objects.hulls import Hull, few_vertices, hull_of
from datagen.workers.objects.object_files import DESCRIPTIONS, TABLE, ObjectFiles
from datagen.workers.objects.scan import MAX_SIZE_M, Scan
from datagen.workers.objects.surfaces import Surface, SurfaceReader, joined, mesh_of, plain_surface
from datagen.workers.objects.ycb_masses import (
    MAX_DENSITY_KG_M3,
    MIN_DENSITY_KG_M3,
    PUBLISHED_MASS_KG,
    reason_to_exclude,
)

Given = dict[str, Any]  # what a row of the table states of an object
Notes = dict[str, str]  # by cause

MIN_SIZE_M = 0.005
_MOST_CORNERS = 64
_FILLED = 0.95
_LARGE_M, _MOST_KG = 0.6, 50.0
# Half of the YCB objects have less than 466 kg per m3 of their convex parts.
DEFAULT_DENSITY_KG_M3 = 500.0
# By a word in the names of its materials; of household things, whose parts fill what is hollow.
_DENSITIES_KG_M3 = {
    "wood|oak|pine|bamboo": 600.0,
    "ceramic|porcelain|clay|stone": 1500.0,
    "glass": 1200.0,
    "metal|steel|iron|alumin|brass": 2500.0,
    "foam|sponge": 50.0,
    "paper|cardboard|carton": 300.0,
    "rubber": 1000.0,
    "fabric|cloth|plush": 150.0,
}


def _number(low: float, high: float) -> Callable[[str], float]:
    def within(text: str) -> float:
        if not low <= (value := float(text)) <= high:
            raise ValueError
        return value

    return within


def _up(text: str) -> str:
    rotation_of(text)  # KeyError for another
    return text


# How each column of the table is read; ValueError or KeyError for what it cannot hold.
GIVEN: dict[str, Callable[[str], Any]] = {
    "mass_kg": _number(1e-4, 50.0),
    "density_kg_m3": _number(MIN_DENSITY_KG_M3, MAX_DENSITY_KG_M3),
    "scale": _number(1e-6, 1e6),
    "up": _up,
}


@dataclass(frozen=True)
class ReadObject:
    """An object; `notes` says by cause what was assumed and what is missing."""

    scan: Scan
    mass_kg: float
    notes: Notes


def read_object(entry: ObjectFiles, root: Path, given: Given) -> ReadObject:
    """The object of files below `root`. Raises InputError naming the file that cannot be used."""
    reader = SurfaceReader(root)
    if entry.path.suffix.lower() in DESCRIPTIONS:
        described = read_description(reader.inside(entry.path), reader.inside)
    else:
        described = Description([_piece(entry.path)], [*map(_piece, entry.collisions)], None)
    visual = joined([_surface(reader, piece) for piece in described.visuals or described.collisions])
    bodies = [_surface(reader, piece) for piece in described.collisions]
    notes: Notes = {}
    T, scale = _frame(entry, visual, given, notes)
    visual, bodies = visual.moved(T, scale), [body.moved(T, scale) for body in bodies]
    points = visual.vertices[np.unique(visual.faces)]
    low, high = points.min(axis=0), points.max(axis=0)
    T[:3, :3], T[:3, 3] = np.eye(3), -(low + high) / 2
    if (high - low).max() > _LARGE_M:
        notes["large"] = f"{(high - low).max():.2f} m"
    if np.abs(T[:3, 3]).max() > 2 * (high - low).max():
        notes["far from its origin"] = f"{np.abs(T[:3, 3]).max():.2f} m"
    visual, bodies = visual.moved(T), [body.moved(T) for body in bodies]
    volume_m3 = closed_volume_m3(visual)
    if volume_m3 == 0:
        notes["not watertight"] = ""
    visual = visual.turned() if volume_m3 < 0 else visual
    parts = _parts(str(entry.path), visual, bodies, notes)
    materials = " ".join(sorted(reader.materials)).lower()
    mass_kg = _mass_kg(entry, given, described, materials, parts.volume_m3, notes)
    x, y, z = map(float, high - low)
    return ReadObject(Scan(mesh_of(visual), parts, (x, y, z)), mass_kg, notes | reader.said)


def _piece(mesh: Path) -> Piece:
    return Piece(np.eye(4), mesh, np.ones(3), "", np.zeros(0), None)


def _surface(reader: SurfaceReader, piece: Piece) -> Surface:
    if piece.mesh is not None:
        image = None if piece.image is None else reader.image(piece.image, piece.image.name)
        return reader.read(piece.mesh).painted(piece.rgb, image).moved(piece.T, piece.scale)
    size, make = piece.size_m, trimesh.creation
    if piece.solid == "box":
        solid = make.box(size)
    elif piece.solid == "cylinder":
        solid = make.cylinder(size[0], size[1], sections=32)
    elif piece.solid == "capsule":
        solid = make.capsule(height=size[1], radius=size[0], count=[16, 16])
    else:
        solid = make.icosphere(subdivisions=2)
        solid.vertices *= size / 2 if len(size) == 3 else size[0]
    return plain_surface(solid.vertices, solid.faces).painted(piece.rgb).moved(piece.T)


def _frame(entry: ObjectFiles, visual: Surface, given: Given, notes: Notes) -> tuple[Any, float]:
    """The rotation (4, 4) that puts a surface upright, after its scale to metres."""
    points = visual.vertices[np.unique(visual.faces)]
    size = np.ptp(points, axis=0)
    scale = float(given.get("scale", unit_m(size)))
    if "scale" not in given and scale != 1:
        notes["in millimetres"] = f"it spans {size.max():.4g}"
    if not MIN_SIZE_M <= size.max() * scale <= MAX_SIZE_M:
        problem = f"wrong size: {size.max() * scale:.3g} m, where {MIN_SIZE_M} to {MAX_SIZE_M} m are expected"
        raise InputError(entry.path, "", problem, f"State its scale in {TABLE}")
    T = np.eye(4)
    if "up" in given:
        T[:3, :3] = rotation_of(given["up"])
        return T, scale
    try:
        T[:3, :3], how = upright(points * scale)
    except (QhullError, ValueError):
        raise InputError(entry.path, "", "has no volume", "Give a solid body") from None
    if how:
        cause, _, detail = how.partition(": ")
        notes[cause] = detail
    return T, scale


def _parts(place: str, visual: Surface, bodies: list[Surface], notes: Notes) -> ConvexParts:
    """Given convex parts, else those of a decomposition, each of few corners."""
    found: list[Any] | None = None
    hull = hull_of(visual.vertices[np.unique(visual.faces)])
    if bodies:
        found = _given_parts(bodies)
        corners = np.concatenate(found or [visual.vertices])
        size = hull.high_m - hull.low_m
        gap = np.abs([corners.min(axis=0) - hull.low_m, corners.max(axis=0) - hull.high_m]).max()
        if gap > 0.01 + 0.05 * size.max():
            notes["collision mesh not used"] = f"its bounding box is {gap:.3g} m off"
            found, bodies = None, []
    elif _is_convex(visual, hull):
        found = [hull.vertices_m]
    is_given = found is not None
    if found is None:
        found = list(decompose(joined(bodies) if bodies else visual, place))
    parts = convex_parts(map(_few_corners, convex_parts(found).vertices_m))
    if not parts.vertices_m:
        raise InputError(place, "", "has no convex part with volume", "Give a solid body")
    if not is_given:
        notes["decomposed"] = error_text(visual, parts.vertices_m)
    return parts


def _few_corners(points_m: F32) -> F64:
    corners_m = hull_of(points_m).vertices_m
    try:
        return few_vertices(corners_m, _MOST_CORNERS)
    except QhullError:  # nearly flat
        return corners_m


def _is_convex(surface: Surface, hull: Hull) -> bool:
    """Whether a surface, perhaps with small holes, fills its hull: a cup of one sheet has no lid."""
    cones = surface.vertices[surface.faces] - hull.vertices_m.mean(axis=0)
    share = abs(np.linalg.det(cones).sum()) / 6 / hull.volume_m3
    return share > _FILLED and not not_convex(surface.vertices, surface.faces)


def _given_parts(bodies: list[Surface]) -> list[Any] | None:
    """The vertices of each group or connected piece, None where one is not convex."""
    found: list[Any] = []
    for body in bodies:
        points, at = np.unique(np.round(body.vertices, 6), axis=0, return_inverse=True)
        faces = at.reshape(-1)[body.faces]
        groups = [g for g in np.split(faces, np.unique(body.cuts)) if len(g)]
        groups = groups if len(groups) > 1 else components(faces, len(points))
        if len(found) + len(groups) > MAX_PARTS or any(not_convex(points, group) for group in groups):
            return None
        found += [points[np.unique(group)] for group in groups]
    return found if convex_parts(found).vertices_m else None


def _mass_kg(
    entry: ObjectFiles, given: Given, described: Description, materials: str, volume_m3: float, notes: Notes
) -> float:
    """Of the table, the YCB's data sheet or the file, else by a density, which is noted."""
    density, why = float(given.get("density_kg_m3", 0)), "of the table"
    mass_kg = float(given.get("mass_kg", 0)) or (0 if density else PUBLISHED_MASS_KG.get(entry.name, 0))
    if not mass_kg and not density and described.mass_kg:
        if MIN_DENSITY_KG_M3 <= described.mass_kg / volume_m3 <= MAX_DENSITY_KG_M3:
            mass_kg = described.mass_kg
        else:
            stated = f"{described.mass_kg:g} kg, {described.mass_kg / volume_m3:.3g} kg/m3"
            notes["mass not plausible"] = f"the file states {stated}"
    measured = mass_kg > 0
    if not measured:
        if not density and described.density_kg_m3:
            density, why = described.density_kg_m3, "of the file"
        for pattern, by_word in _DENSITIES_KG_M3.items():
            if not density and (word := re.search(pattern, materials)):
                density, why = by_word, f"of {word[0]}"
        if not density:
            density, why = DEFAULT_DENSITY_KG_M3, "assumed"
        mass_kg = density * volume_m3
        notes["mass by density"] = f"{density:g} kg/m3 {why}"
    reason = reason_to_exclude(entry.name, mass_kg, volume_m3, measured)
    if mass_kg > _MOST_KG:
        reason = f"wrong mass: {mass_kg:.3g} kg"
    if reason:
        raise InputError(entry.path, "", reason, f"State its mass in {TABLE}")
    return mass_kg


# A mesh longer than this is not in metres; up to a tenth of it, it could be in centimetres or inches.
_IN_MILLIMETRES = 20.0
# An object stands where the centre is this share of its height within the edge of what it stands on.
_MARGIN = 0.08
# y is up where the mesh rests on y = 0, and more than this share of it is below z = 0.
_AT_ZERO, _SUNK = 0.02, 0.2
_LIKELY = 0.7  # of the best chance: of a pan's two sides, the one below
_NEAR = np.cos(np.radians(10.0))
_UPS = {"z": (0, 0, 1), "-z": (0, 0, -1), "y": (0, 1, 0), "-y": (0, -1, 0), "x": (1, 0, 0), "-x": (-1, 0, 0)}


def unit_m(size: F64) -> float:
    """Metres in a unit of a mesh with these sides (3,): 0.001 for millimetres, else 1."""
    longest = float(size.max())
    return 0.001 if longest >= _IN_MILLIMETRES and longest / 1000 <= MAX_SIZE_M else 1.0


def rotation_of(up: str) -> F64:
    """The rotation (3, 3) that turns a direction, "y" or "-x", to z. Raises KeyError for another text."""
    return _turning(np.array(_UPS[up], np.float64))


def upright(points_m: F64) -> tuple[F64, str]:
    """The rotation (3, 3) that puts points (N, 3) upright, and what was done, "" for nothing.

    z stays up where the hull stands so. Else y is up, where the points rest on y = 0 or stand so, else
    the direction of the most probable rests that is nearest to z: facets below the centre, by solid angle.
    """
    hull = ConvexHull(points_m)
    corners = points_m[hull.simplices]
    points_m = points_m[hull.vertices]
    inner = points_m.mean(axis=0)
    volumes = np.abs(np.linalg.det(corners - inner))
    centre = np.average(corners.mean(axis=1) * 0.75 + inner * 0.25, axis=0, weights=volumes)
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    on_y = abs(low[1]) < _AT_ZERO * (high - low).max() and low[2] < -_SUNK * (high[2] - low[2])
    for up in ("y", "z") if on_y else ("z", "y"):
        if _stands(points_m @ rotation_of(up).T, rotation_of(up) @ centre):
            return rotation_of(up), "" if up == "z" else "y was up"
    down = hull.equations[:, :3]
    a, b, c = (corners[:, k] - centre for k in range(3))
    lengths = [np.linalg.norm(x, axis=1) for x in (a, b, c)]
    dots = [
        (x * y).sum(axis=1) * z for x, y, z in ((a, b, lengths[2]), (b, c, lengths[0]), (c, a, lengths[1]))
    ]
    angle = 2 * np.arctan2(
        np.abs(np.linalg.det(np.stack([a, b, c], axis=1))), np.prod(lengths, axis=0) + sum(dots)
    )
    below = [
        k for k in range(len(down)) if _stands(points_m @ _turning(-down[k]).T, _turning(-down[k]) @ centre)
    ]
    if not below:
        return np.eye(3), "stands on no side: z is kept up"
    chances = np.array([angle[down @ down[k] > _NEAR].sum() for k in below])
    likely = [k for k, chance in zip(below, chances, strict=True) if chance > _LIKELY * chances.max()]
    down_m = min((tuple(np.round(down[k], 6)) for k in likely), key=lambda n: (n[2], n))
    return _turning(-np.array(down_m) / np.linalg.norm(down_m)), "laid on its side"


def _stands(points_m: F64, centre: F64) -> bool:
    """Whether the centre is above what lies within 1% of the height of the lowest point, with a margin."""
    z = points_m[:, 2]
    height = float(np.ptp(z))
    feet = points_m[z <= z.min() + max(0.01 * height, 5e-4), :2]
    if len(feet) < 3 or np.linalg.matrix_rank(feet - feet[0], tol=1e-6) < 2:
        return False
    edges = ConvexHull(feet).equations
    return bool((edges[:, :2] @ centre[:2] + edges[:, 2]).max() < -_MARGIN * (centre[2] - z.min()))


def _turning(direction: F64) -> F64:
    """The shortest rotation (3, 3) that turns a unit direction to z."""
    x, y, z = direction
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]]
    )
