"""Convex solids from which furniture is assembled, as plain arrays.

Frame of a piece of furniture: x right, y front, z up, origin on the floor below its centre,
metres. Every solid here is convex, closed and wound outwards, and has 6 to 24 corners.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from datagen.workers.geometry.mesh import F32, F64, I32, Mesh
from datagen.workers.json_document import JsonNode

Rgb = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class ColouredSolid:
    """One convex part with a colour."""

    vertices_m: F32  # (V, 3)
    faces: I32  # (F, 3)
    rgb: Rgb


@lru_cache(maxsize=64)
def _prism_faces(sides: int) -> I32:
    """Triangles of a prism: bottom corners 0..n-1 counter-clockwise from above, then the top's."""
    ring = np.arange(sides)
    following = (ring + 1) % sides
    walls = np.concatenate(
        [
            np.stack([ring, following, following + sides], 1),
            np.stack([ring, following + sides, ring + sides], 1),
        ]
    )
    fan = np.arange(1, sides - 1)
    bottom = np.stack([np.zeros_like(fan), fan + 1, fan], 1)
    top = np.stack([np.full_like(fan, sides), fan + sides, fan + 1 + sides], 1)
    faces = np.concatenate([walls, bottom, top]).astype(np.int32)
    faces.setflags(write=False)
    return faces


def prism(bottom_m: F64, top_m: F64, rgb: Rgb) -> ColouredSolid:
    """A solid between two polygons (K, 3) of equal length, both counter-clockwise from outside above."""
    return ColouredSolid(
        np.concatenate([bottom_m, top_m]).astype(np.float32), _prism_faces(len(bottom_m)), rgb
    )


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], rgb: Rgb) -> ColouredSolid:
    """A box given by its intervals along x, y and z."""
    ring = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    corners = np.array([(a, b, z[0]) for a, b in ring] + [(a, b, z[1]) for a, b in ring], np.float32)
    return ColouredSolid(corners, _prism_faces(4), rgb)


@lru_cache(maxsize=64)
def _circle(sides: int) -> F64:
    """A regular polygon (sides, 2), stretched so that its bounding box is exactly [-1, 1]."""
    angle = (np.arange(sides) + 0.5) * (2 * np.pi / sides)
    corners = np.stack([np.cos(angle), np.sin(angle)], 1)
    return corners / np.abs(corners).max(0)


def mirrored(
    x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], rgb: Rgb
) -> list[ColouredSolid]:
    """A box given by its intervals and its mirror image on the left, which comes first."""
    return [box((-x[1], -x[0]), y, z, rgb), box(x, y, z, rgb)]


def frustum(
    z: tuple[float, float],
    bottom_m: tuple[float, float],
    top_m: tuple[float, float],
    rgb: Rgb,
    sides: int = 10,
    centre_m: tuple[float, float] = (0.0, 0.0),
) -> ColouredSolid:
    """A (tapered, elliptic) column from the radii (x, y) at its bottom to those at its top."""
    circle = _circle(sides)
    low = np.column_stack([circle * bottom_m + centre_m, np.full(sides, z[0])])
    high = np.column_stack([circle * top_m + centre_m, np.full(sides, z[1])])
    return prism(low, high, rgb)


def profile(yz_m: Sequence[tuple[float, float]], x: tuple[float, float], rgb: Rgb) -> ColouredSolid:
    """A convex side view, points (y, z) counter-clockwise with y right and z up, extruded along x."""
    side = np.array(yz_m, np.float64)
    near = np.column_stack([np.full(len(side), x[0]), side])
    far = np.column_stack([np.full(len(side), x[1]), side])
    # Seen from +x, y points right and z up: the far polygon is the "top" of the prism.
    return prism(near, far, rgb)


@lru_cache(maxsize=4)
def _unit_ball(sides: int) -> tuple[F64, I32]:
    heights = np.sin(np.deg2rad([-45.0, 0.0, 45.0]))
    radii = np.cos(np.deg2rad([-45.0, 0.0, 45.0]))
    ring = _circle(sides)
    rings = [np.column_stack([ring * r, np.full(sides, h)]) for r, h in zip(radii, heights, strict=True)]
    vertices = np.concatenate([*rings, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    i = np.arange(sides)
    j = (i + 1) % sides
    quads = [
        np.concatenate([np.stack([a + i, a + j, b + j], 1), np.stack([a + i, b + j, b + i], 1)])
        for a, b in ((0, sides), (sides, 2 * sides))
    ]
    south = np.stack([j, i, np.full(sides, 3 * sides)], 1)
    north = np.stack([2 * sides + i, 2 * sides + j, np.full(sides, 3 * sides + 1)], 1)
    return vertices, np.concatenate([*quads, south, north]).astype(np.int32)


def ball(
    centre_m: tuple[float, float, float], radii_m: tuple[float, float, float], rgb: Rgb
) -> ColouredSolid:
    """An ellipsoid of 20 corners that touches all six sides of its bounding box."""
    vertices, faces = _unit_ball(6)
    return ColouredSolid((vertices * radii_m + centre_m).astype(np.float32), faces, rgb)


def join(solids: Sequence[ColouredSolid]) -> tuple[Mesh, tuple[F32, ...]]:
    """One mesh of all solids, in order, and their corners as convex parts (V, 3)."""
    counts = [len(s.vertices_m) for s in solids]
    offsets = np.cumsum([0, *counts[:-1]])
    faces = np.concatenate([s.faces + np.int32(o) for s, o in zip(solids, offsets, strict=True)])
    colours = np.repeat(np.array([s.rgb for s in solids], np.uint8), [len(s.faces) for s in solids], axis=0)
    vertices = np.concatenate([s.vertices_m for s in solids])
    return Mesh(vertices, faces.astype(np.int32), colours), tuple(s.vertices_m for s in solids)


def placed(mesh: Mesh, parts_m: tuple[F32, ...], T_world_local: F64) -> tuple[Mesh, tuple[F32, ...]]:
    """The mesh and its parts in the world frame; `parts_m` must be the mesh's vertices in order."""
    moved = mesh.transformed(T_world_local)
    out: list[F32] = []
    start = 0
    for part in parts_m:
        out.append(moved.vertices_m[start : start + len(part)])
        start += len(part)
    return moved, tuple(out)


_BY_WORD: tuple[tuple[str, Rgb], ...] = (  # the first that a name contains
    ("yellow", (222, 196, 120)),
    ("orange", (210, 150, 96)),
    ("brown", (130, 94, 66)),
    ("grey", (140, 140, 140)),
    ("gray", (140, 140, 140)),
    ("blue", (120, 146, 178)),
    ("green", (132, 158, 124)),
    ("red", (166, 84, 74)),
    ("black", (52, 50, 50)),
    ("white", (228, 226, 220)),
    ("tan", (204, 178, 144)),
    ("brick", (150, 84, 66)),
    ("wood", (164, 122, 82)),
    ("parquet", (158, 112, 70)),
    ("cabinet", (150, 104, 66)),
    ("marble", (206, 202, 196)),
    ("granite", (128, 126, 124)),
    ("concrete", (160, 158, 154)),
    ("tile", (196, 192, 184)),
    ("ceramic", (204, 200, 190)),
    ("porcelain", (224, 220, 210)),
    ("carpet", (138, 130, 120)),
    ("fabric", (150, 140, 128)),
    ("plaster", (222, 208, 176)),
    ("drywall", (214, 206, 194)),
    ("eggshell", (230, 224, 208)),
    ("metal", (168, 170, 174)),
)
_FLOORS: tuple[Rgb, ...] = (
    (164, 122, 82), (140, 98, 62), (186, 150, 110), (176, 172, 164), (120, 108, 98), (150, 134, 118),
)  # fmt: skip
_WALLS: tuple[Rgb, ...] = (
    (226, 220, 208), (206, 212, 208), (214, 200, 178), (190, 200, 208), (218, 208, 214), (200, 196, 188),
)  # fmt: skip


def hash_bytes(text: str) -> bytes:
    """32 bytes that depend on the text alone, the same on every machine."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()


def pick(palette: tuple[Rgb, ...], key: str) -> Rgb:
    """One colour of the palette, shaded by up to 8%, stable for the key."""
    h = hash_bytes(key)
    return shade(palette[h[0] % len(palette)], 0.92 + 0.16 * h[1] / 255)


def shade(rgb: Rgb, factor: float) -> Rgb:
    """A lighter or darker tone of the colour."""
    r, g, b = (min(255, max(0, round(c * factor))) for c in rgb)
    return (r, g, b)


def material_rgb(material: JsonNode | None, of_floor: bool) -> Rgb:
    """Colour of a wall or floor material `{name, color?: {r, g, b}}` (0 to 1 each), or of its name."""
    if material is None:
        return (176, 172, 164) if of_floor else (218, 214, 206)
    colour = None if isinstance(material.value, str) else material.find("color")
    if colour is not None:
        r, g, b = (round(255 * colour.get(c).number(0.0, 1.0)) for c in "rgb")
        return (r, g, b)
    return named_rgb(material_name(material), of_floor)


def material_name(material: JsonNode | None) -> str:
    """The name of a material; older files have it without an object around it."""
    name = material if material is None or isinstance(material.value, str) else material.find("name")
    return "" if name is None else name.text()


def named_rgb(name: str, of_floor: bool) -> Rgb:
    """The colour that a material's name suggests, else one of a palette, stable for the name."""
    lower = name.lower()
    for word, rgb in _BY_WORD:
        if word in lower:
            return pick((rgb,), name)
    return pick(_FLOORS if of_floor else _WALLS, name)
