"""Pairs of contacts of two fingers on opposite sides of a union of convex parts.

Parts of a decomposition overlap, so rays also hit faces inside the object. Each line is therefore clipped
against every part as a whole, and the intervals are joined: their ends lie on the true surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from datagen.workers.geometry.mesh import F32, F64

Ints = npt.NDArray[np.int64]

# Half-angle of the friction cone; friction 0.6, as objects have in physics.
CONE_RAD = float(np.arctan(0.6))
# Cracks between neighbouring parts are closed up to this width.
_CRACK_M = 5e-4
_ON_SURFACE_M = 1e-5
_LINES_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """P convex parts as M half-spaces: a point x is inside a part where n . x + c <= 0 for all its rows."""

    planes: F64  # (M, 4), unit normals outwards
    first: Ints  # (P,), row of each part's first plane
    part: Ints  # (M,), part of each plane
    triangles_m: F64  # (T, 3, 3), of all hulls
    normals: F64  # (T, 3)


@dataclass(frozen=True, eq=False)
class Contacts:
    """N pairs of surface points whose line lies in both friction cones (Nguyen 1988, IJRR 7:3)."""

    first_m: F64  # (N, 3)
    second_m: F64  # (N, 3)
    closing: F64  # (N, 3), unit, from the first to the second

    def __len__(self) -> int:
        return len(self.first_m)

    @property
    def width_m(self) -> F64:
        """Distances (N,) between the two points."""
        return np.linalg.norm(self.second_m - self.first_m, axis=1)


def solid_of(parts_m: Sequence[F32]) -> HalfSpaces:
    """The union of convex parts, each given by its corners (V, 3)."""
    planes: list[F64] = []
    triangles: list[F64] = []
    normals: list[F64] = []
    for part in parts_m:
        points = part.astype(np.float64)
        hull = ConvexHull(points)
        # Qhull gives one row for each triangle: faces with many corners repeat their plane.
        unique = np.unique(np.round(hull.equations, 9), axis=0, return_index=True)[1]
        planes.append(hull.equations[np.sort(unique)])
        triangles.append(points[hull.simplices])
        normals.append(hull.equations[:, :3])
    counts = [len(p) for p in planes]
    return HalfSpaces(
        np.concatenate(planes),
        np.cumsum([0, *counts[:-1]]),
        np.repeat(np.arange(len(planes)), counts),
        np.concatenate(triangles),
        np.concatenate(normals),
    )


def surface_points(solid: HalfSpaces, n: int, rng: np.random.Generator) -> tuple[F64, F64]:
    """Points (N, 3), N <= n, uniform over the surface of the union, and outward normals (N, 3).

    Draws n points over the hulls of all parts and drops those that lie inside another part.
    """
    edge = solid.triangles_m[:, 1:] - solid.triangles_m[:, :1]
    area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
    chosen = rng.choice(len(area), n, p=area / area.sum())
    # Uniform in a triangle: fold the square's far half back (Turk 1990, Graphics Gems).
    uv = rng.random((n, 2))
    far = uv.sum(axis=1) > 1
    uv[far] = 1 - uv[far]
    points = solid.triangles_m[chosen, 0] + np.einsum("nk,nki->ni", uv, edge[chosen])
    chunks = np.split(points, range(_LINES_AT_ONCE, n, _LINES_AT_ONCE))
    keep = np.concatenate([_outside(solid, chunk) for chunk in chunks])
    return points[keep], solid.normals[chosen[keep]]


def _outside(solid: HalfSpaces, points_m: F64) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) lie in no part's interior."""
    height = points_m @ solid.planes[:, :3].T + solid.planes[:, 3]
    depth = -np.maximum.reduceat(height, solid.first, axis=1)  # (N, P) below each part's surface
    return depth.max(axis=1) < _ON_SURFACE_M


def cone_directions(normals: F64, rng: np.random.Generator) -> F64:
    """Unit directions (N, 3) into the surface, within `CONE_RAD` of its normal and mostly close to it."""
    n = len(normals)
    angle = CONE_RAD * rng.random(n) ** 2
    turn = 2 * np.pi * rng.random(n)
    u, v = perpendicular(normals)
    aside = np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v
    return -np.cos(angle)[:, None] * normals + np.sin(angle)[:, None] * aside


def perpendicular(axes: F64) -> tuple[F64, F64]:
    """Two unit vectors (N, 3) each, at right angles to the unit axes (N, 3) and to one another."""
    other = np.eye(3)[np.abs(axes).argmin(axis=1)]
    u: F64 = np.cross(axes, other)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v: F64 = np.cross(axes, u)
    return u, v


def contact_pairs(solid: HalfSpaces, points_m: F64, directions: F64, max_width_m: float) -> Contacts:
    """The pairs on the lines that enter the union at the points (N, 3) along unit directions (N, 3).

    A line may leave the union and enter it again. Its first end gives a grasp of the wall alone, such as a
    rim; its last end within `max_width_m` gives a grasp around everything between.
    """
    first: list[F64] = []
    second: list[F64] = []
    closing: list[F64] = []
    for start in range(0, len(points_m), _LINES_AT_ONCE):
        p, d = points_m[start : start + _LINES_AT_ONCE], directions[start : start + _LINES_AT_ONCE]
        rows, ends, normals = _ends(solid, p, d, max_width_m)
        fits = np.einsum("ni,ni->n", normals, d[rows]) >= np.cos(CONE_RAD)
        rows, ends = rows[fits], ends[fits]
        first.append(p[rows])
        second.append(p[rows] + ends[:, None] * d[rows])
        closing.append(d[rows])
    return Contacts(np.concatenate(first), np.concatenate(second), np.concatenate(closing))


def _ends(solid: HalfSpaces, p: F64, d: F64, max_width_m: float) -> tuple[Ints, F64, F64]:
    """Rows (K,) of the lines, distances (K,) at which they leave the union, and normals (K, 3) there."""
    into = d @ solid.planes[:, :3].T  # (N, M)
    height = p @ solid.planes[:, :3].T + solid.planes[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -height / into
    enter = np.where(into < 0, t, -np.inf)
    leave = np.where(into > 0, t, np.inf)
    # A line along a plane and outside it never meets the part.
    enter[(into == 0) & (height > 0)] = np.inf
    low = np.maximum.reduceat(enter, solid.first, axis=1)  # (N, P)
    high = np.minimum.reduceat(leave, solid.first, axis=1)
    missed = low >= high
    low[missed], high[missed] = np.inf, -np.inf
    order = np.argsort(low, axis=1, kind="stable")
    low = np.take_along_axis(low, order, 1)
    high = np.take_along_axis(high, order, 1)
    reach = np.maximum.accumulate(high, axis=1)
    by = _argmax_so_far(high)
    # A solid stretch ends where the next part begins beyond all that came before.
    following = np.concatenate([low[:, 1:], np.full((len(p), 1), np.inf)], axis=1)
    is_end = (following > reach + _CRACK_M) & (reach > _CRACK_M)
    begins = np.concatenate([np.full((len(p), 1), -np.inf), reach[:, :-1]], axis=1)
    starts_stretch = low > begins + _CRACK_M
    # The stretch that holds the point must begin there, or the point is inside a crack.
    entered = np.where(starts_stretch & (low < _CRACK_M), low, -np.inf).max(axis=1)
    is_end &= (entered > -_CRACK_M)[:, None] & (reach <= max_width_m)
    any_end = is_end.any(axis=1)
    nearest = is_end.argmax(axis=1)
    last = is_end.shape[1] - 1 - is_end[:, ::-1].argmax(axis=1)
    again = any_end & (last != nearest)
    rows = np.concatenate([np.flatnonzero(any_end), np.flatnonzero(again)])
    column = np.concatenate([nearest[any_end], last[again]])
    ends = reach[rows, column]
    part = order[rows, by[rows, column]]
    off = np.where(solid.part == part[:, None], np.abs(leave[rows] - ends[:, None]), np.inf)
    return rows, ends, solid.planes[off.argmin(axis=1), :3]


def _argmax_so_far(values: F64) -> Ints:
    """Column (N, P) of the largest entry of the row up to each entry."""
    columns = np.arange(values.shape[1])
    best = np.maximum.accumulate(values, axis=1)
    earlier = np.concatenate([np.full((len(values), 1), -np.inf), best[:, :-1]], axis=1)
    return np.maximum.accumulate(np.where(values > earlier, columns, 0), axis=1)
