"""Planar geometry of the floor: footprints, distances, containment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64

_FEW_CORNERS = 4


def convex_hull(points_m: F32 | F64) -> F64:
    """Counter-clockwise convex hull (K, 2) of planar points (N, 2), by two chains (Andrew 1979).

    Points on a line, which have no area, give their two ends. For the few corners of a body part
    this is several times faster than a general algorithm.
    """
    points = sorted({(x, y) for x, y in np.asarray(points_m, np.float64).tolist()})
    if len(points) < 3:
        return np.array([points[0], points[-1]], np.float64)
    return np.array(_right_turns_cut(points) + _right_turns_cut(points[::-1]), np.float64)


def _right_turns_cut(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The chain of left turns from the first point to the last, which is left out."""
    chain: list[tuple[float, float]] = []
    for x, y in points:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            chain.pop()
        chain.append((x, y))
    return chain[:-1]


def cross(a: F64, b: F64) -> F64:
    """The cross products (...) of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def unit_circle(corners: int, first: float = 0.0) -> F64:
    """Corners (K, 2) of a regular polygon in the unit circle, counter-clockwise from `first` steps off x."""
    angle = 2 * np.pi * (np.arange(corners) + first) / corners
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def prism_corners(outline_m: F64, low_m: float, high_m: float) -> F64:
    """Corners (2 K, 3) of an upright prism over an outline (K, 2), the lower ones first."""
    return np.concatenate([np.column_stack([outline_m, np.full(len(outline_m), z)]) for z in (low_m, high_m)])


def stack_polygons(polygons_m: Sequence[F64]) -> F64:
    """Polygons of different length as one array (P, K, 2), padded by repeating the last corner."""
    longest = max((len(p) for p in polygons_m), default=1)
    padded = [np.concatenate([p, np.repeat(p[-1:], longest - len(p), axis=0)]) for p in polygons_m]
    return np.array(padded, np.float64).reshape(len(polygons_m), longest, 2)


def following(polygons_m: F64) -> F64:
    """The next corner of each corner of polygons (..., K, 2); `np.roll` takes four times as long."""
    return np.concatenate([polygons_m[..., 1:, :], polygons_m[..., :1, :]], axis=-2)


def signed_distances_to_convex(points_m: F64, polygons_m: F64) -> F64:
    """Distance (N, P) of points (N, 2) from counter-clockwise convex polygons (P, K, 2).

    Negative inside. A polygon may repeat corners; one without area has no inside.
    """
    if polygons_m.shape[1] > _FEW_CORNERS:
        # Most footprints are rectangles, padded to the length of the few round ones.
        few = (polygons_m[:, _FEW_CORNERS:] == polygons_m[:, _FEW_CORNERS - 1, None]).all((1, 2))
        if few.any():
            distances = np.empty((len(points_m), len(polygons_m)))
            distances[:, few] = signed_distances_to_convex(points_m, polygons_m[few, :_FEW_CORNERS])
            distances[:, ~few] = _signed_distances(points_m, polygons_m[~few])
            return distances
    return _signed_distances(points_m, polygons_m)


def _signed_distances(points_m: F64, polygons_m: F64) -> F64:
    # Sides come first, and arrays are reused: reductions over a short last axis and new memory are slow.
    first, second = polygons_m, following(polygons_m)
    area = cross(first, second).sum(1)
    along_x, along_y = np.ascontiguousarray((second - first).T)[:, :, None]  # (K, 1, P)
    x, y = points_m.T[:, None, :, None] - np.ascontiguousarray(first.T)[:, :, None]  # (K, N, P)
    t, other = x * along_x, y * along_y
    t += other
    t /= np.maximum(along_x**2 + along_y**2, 1e-18)
    np.clip(t, 0.0, 1.0, out=t)
    left = (along_x * y >= np.multiply(along_y, x, out=other)).all(0)
    x -= np.multiply(t, along_x, out=other)
    y -= np.multiply(t, along_y, out=other)
    x *= x
    y *= y
    x += y
    border = np.sqrt(x.min(0))
    return np.where(left & (area > 1e-12), -border, border)


def polygons_at(polygon_m: F64, xy_m: F64, yaw_rad: F64) -> F64:
    """A polygon (K, 2) with its origin at positions (N, 2), turned counter-clockwise by (N,): (N, K, 2)."""
    (x, y), c, s = polygon_m.T, np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    return xy_m[:, None] + np.stack([c * x - s * y, s * x + c * y], axis=2)


def signed_distances_between(first_m: F64, second_m: F64, only_signs: bool = False) -> F64:
    """Distance (M,) of counter-clockwise convex polygons (M, K, 2) and (M, L, 2), pair by pair.

    Negative where they overlap: the length of the shortest motion that parts them. The second ones may repeat
    corners, and may have no area. With `only_signs` distances of polygons that are apart are lower bounds.
    """
    if second_m.shape[1] > _FEW_CORNERS:
        few = (second_m[:, _FEW_CORNERS:] == second_m[:, _FEW_CORNERS - 1, None]).all((1, 2))
        if few.any():
            distances = np.empty(len(first_m))
            distances[few] = signed_distances_between(first_m[few], second_m[few, :_FEW_CORNERS], only_signs)
            distances[~few] = _signed_between(first_m[~few], second_m[~few], only_signs)
            return distances
    return _signed_between(first_m, second_m, only_signs)


def _signed_between(first_m: F64, second_m: F64, only_signs: bool) -> F64:
    # Of overlapping polygons the direction that parts them is normal to a side of one (separating axes).
    found = np.maximum(_beyond_sides(first_m, second_m), _beyond_sides(second_m, first_m))
    apart = (found > 0) & (not only_signs)
    first_m, second_m = first_m[apart], second_m[apart]
    nearest = (_corners_to_sides(first_m, second_m), _corners_to_sides(second_m, first_m))
    found[apart] = np.minimum(*nearest)
    return found


def _beyond_sides(polygons_m: F64, others_m: F64) -> F64:
    """The largest distance (M,) of others (M, L, 2) beyond the line of a side; negative where none are."""
    along = following(polygons_m) - polygons_m
    length = np.sqrt((along**2).sum(2))
    rel = others_m[:, None] - polygons_m[:, :, None]  # (M, K, L, 2)
    beyond = (along[:, :, None, 1] * rel[..., 0] - along[:, :, None, 0] * rel[..., 1]).min(2)
    return np.where(length > 1e-9, beyond / np.maximum(length, 1e-9), -np.inf).max(1)


def _corners_to_sides(corners_m: F64, polygons_m: F64) -> F64:
    """The smallest distance (M,) of corners (M, L, 2) from sides of polygons (M, K, 2)."""
    along = (following(polygons_m) - polygons_m)[:, :, None]
    rel = corners_m[:, None] - polygons_m[:, :, None]  # (M, K, L, 2)
    t = np.clip((rel * along).sum(3) / np.maximum((along**2).sum(3), 1e-18), 0.0, 1.0)
    return np.sqrt(((rel - t[..., None] * along) ** 2).sum(3).min((1, 2)))


def distance_to_border(polygon_m: F64) -> float:
    """Distance of the origin from the border of a polygon (K, 2)."""
    sides = np.stack([polygon_m, following(polygon_m)], axis=1)
    return float(signed_distances_to_convex(np.zeros((1, 2)), sides).min())  # a side has no inside


def inside_polygon(points_m: F64, polygon_m: F64) -> npt.NDArray[np.bool_]:
    """Whether points (N, 2) lie in a simple polygon (K, 2), by the even-odd rule."""
    x, y = points_m.T
    start_x, start_y = polygon_m.T[..., None]  # (K, 1)
    end_x, end_y = following(polygon_m).T[..., None]
    spans = (start_y > y) != (end_y > y)
    rise = np.where(spans, end_y - start_y, 1.0)
    crossing = start_x + (y - start_y) / rise * (end_x - start_x)
    return (spans & (x < crossing)).sum(0) % 2 == 1


def inside_any(points_m: F64, polygons_m: Sequence[F64]) -> npt.NDArray[np.bool_]:
    """Whether points (N, 2) lie in at least one of the polygons."""
    inside = np.zeros(len(points_m), np.bool_)
    for polygon_m in polygons_m:
        inside |= inside_polygon(points_m, polygon_m)
    return inside


def crosses_itself(corners: F64) -> bool:
    """Whether a corner is repeated or two sides cross."""
    ends = np.roll(corners, -1, axis=0)
    if (np.linalg.norm(ends - corners, axis=1) < 1e-6).any():
        return True
    along = (ends - corners)[:, None]

    def side(points: F64) -> F64:
        """Side (K, K) of each edge's line on which points (K, 2) are: 1 left, -1 right, 0 on it."""
        return np.sign(cross(along, points[None] - corners[:, None]))

    parts = side(corners) * side(ends) < 0
    return bool((parts & parts.T).any())
