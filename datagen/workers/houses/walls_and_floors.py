"""Walls as thin boxes around door and window holes, and floors as thin slabs whose top is at z = 0.

House files list an interior wall once per room, in opposite directions. Walls on one line are
therefore merged before they are cut: every stretch of the line gets one box, with the colour of
each side. A wall is seen from the right of its direction (world frame, from above).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from datagen.workers.furniture.solids import ColouredSolid, Rgb, join, prism
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import cross
from datagen.workers.houses.house import StaticBody

MAX_CORNERS = 64
FLOOR_THICKNESS_M = 0.05
_MIN_AREA_M2 = 0.05
_SAME_M = 1e-4


def clean_polygon(corners_m: F64) -> F64 | str:
    """The polygon (K, 2), counter-clockwise, without repeated or straight corners.

    If it is not the outline of a floor, a string that names the problem.
    """
    keep = np.linalg.norm(corners_m - np.roll(corners_m, 1, axis=0), axis=1) > _SAME_M
    points = corners_m[keep]
    if len(points) >= 3:
        points = without_straight_corners(points)
    if len(points) < 3:
        return "fewer than three different corners"
    area_m2 = 0.5 * float(cross(points, np.roll(points, -1, axis=0)).sum())
    if abs(area_m2) < _MIN_AREA_M2:
        return f"an area of {abs(area_m2):.4f} m2"
    points = points if area_m2 > 0 else points[::-1]
    return "edges that cross each other" if _crosses_itself(points) else points


def without_straight_corners(points_m: F64) -> F64:
    """The corners (K, 2) at which a closed line turns."""
    before, after = points_m - np.roll(points_m, 1, axis=0), np.roll(points_m, -1, axis=0) - points_m
    turn = cross(before, after)
    return points_m[np.abs(turn) > 1e-9 + 1e-6 * np.linalg.norm(before, axis=1)]


def triangles(polygon_m: F64) -> list[tuple[int, int, int]]:
    """Corner indices of K - 2 triangles that fill a simple counter-clockwise polygon (ear clipping)."""
    ring = list(range(len(polygon_m)))
    out: list[tuple[int, int, int]] = []
    while len(ring) > 3:
        ear = next((i for i in range(len(ring)) if _is_ear(polygon_m, ring, i)), 0)
        out.append((ring[ear - 1], ring[ear], ring[(ear + 1) % len(ring)]))
        del ring[ear]
    out.append((ring[0], ring[1], ring[2]))
    return out


def floor_solids(polygon_m: F64, rgb: Rgb) -> list[ColouredSolid]:
    """Triangular slabs below z = 0 that fill the polygon."""
    slabs: list[ColouredSolid] = []
    for a, b, c in triangles(polygon_m):
        corners = polygon_m[[a, b, c]]
        if abs(float(cross(corners[1] - corners[0], corners[2] - corners[0]))) < 1e-6:
            continue
        top = np.column_stack([corners, np.zeros(3)])
        slabs.append(prism(top - (0.0, 0.0, FLOOR_THICKNESS_M), top, rgb))
    return slabs


def _is_ear(polygon_m: F64, ring: list[int], i: int) -> bool:
    a, b, c = (polygon_m[ring[k % len(ring)]] for k in (i - 1, i, i + 1))
    if float(cross(b - a, c - b)) <= 0:
        return False
    others = [k for k in ring if k not in (ring[i - 1], ring[i], ring[(i + 1) % len(ring)])]
    p = polygon_m[others]
    inside = (cross(b - a, p - a) >= 0) & (cross(c - b, p - b) >= 0) & (cross(a - c, p - c) >= 0)
    return not inside.any()


def _crosses_itself(points: F64) -> bool:
    start, end = points, np.roll(points, -1, axis=0)
    along = (end - start)[:, None]
    left = cross(along, start[None] - start[:, None])
    right = cross(along, end[None] - start[:, None])
    straddles = (left * right < 0) & (np.abs(left) > 1e-9) & (np.abs(right) > 1e-9)
    return bool((straddles & straddles.T).any())


WALL_THICKNESS_M = 0.02
# A pane that reaches the floor still stops a robot's base.
WINDOW_SILL_M = 0.10
_SAME_LINE_M = 2e-3
_PLAIN: Rgb = (214, 210, 202)
_DOOR_RGB: Rgb = (150, 112, 76)
_Key = tuple[float, tuple[tuple[float, float], ...], Rgb, Rgb]


@dataclass(frozen=True)
class WallSegment:
    """One wall of a house file, from `start_m` to `end_m` (world x, y), `height_m` high."""

    wall_id: str
    start_m: tuple[float, float]
    end_m: tuple[float, float]
    height_m: float
    rgb: Rgb


@dataclass(frozen=True)
class Hole:
    """A door or window in a wall: along the wall from its start, and in height.

    A closed hole is filled by a leaf (a door to the outside).
    """

    wall_id: str
    along_m: tuple[float, float]
    height_m: tuple[float, float]
    is_closed: bool = False


class _Slab(NamedTuple):
    """A prism and the colour of its left side, its third wall."""

    solid: ColouredSolid
    left_rgb: Rgb


@dataclass(frozen=True, eq=False)
class _Line:
    """A vertical plane that holds walls: origin and unit direction in the world's x, y."""

    origin: F64
    direction: F64

    def along(self, point_m: tuple[float, float]) -> float:
        return float((np.array(point_m) - self.origin) @ self.direction)


def wall_bodies(walls: Sequence[WallSegment], holes: Sequence[Hole]) -> list[StaticBody]:
    """Bodies of all walls, one per straight stretch; holes name the wall they are measured along."""
    by_wall: dict[str, list[Hole]] = defaultdict(list)
    for hole in holes:
        by_wall[hole.wall_id].append(hole)
    lines: list[tuple[_Line, list[WallSegment]]] = []
    buckets: dict[tuple[int, int], list[int]] = defaultdict(list)
    for wall in walls:
        _sort_into(wall, lines, buckets)
    bodies: list[StaticBody] = []
    for line, members in lines:
        bodies.extend(_bodies_on_line(line, members, by_wall, len(bodies)))
    return bodies


def _sort_into(
    wall: WallSegment, lines: list[tuple[_Line, list[WallSegment]]], buckets: dict[tuple[int, int], list[int]]
) -> None:
    start, end = np.array(wall.start_m), np.array(wall.end_m)
    direction = (end - start) / np.linalg.norm(end - start)
    if direction[0] < -1e-6 or (abs(direction[0]) <= 1e-6 and direction[1] < 0):
        direction = -direction
    key = (round(float(direction[0]) * 500), round(float(direction[1]) * 500))
    for k in buckets[key]:
        line = lines[k][0]
        offsets = [cross(line.direction, p - line.origin) for p in (start, end)]
        if max(abs(o) for o in offsets) < _SAME_LINE_M:
            lines[k][1].append(wall)
            return
    buckets[key].append(len(lines))
    lines.append((_Line(start, direction), [wall]))


def _bodies_on_line(
    line: _Line, walls: list[WallSegment], by_wall: dict[str, list[Hole]], first: int
) -> list[StaticBody]:
    spans = [tuple(sorted((line.along(w.start_m), line.along(w.end_m)))) for w in walls]
    forward = [line.along(w.end_m) > line.along(w.start_m) for w in walls]
    holes: list[tuple[float, float, float, float]] = []
    leaves: list[_Slab] = []
    for wall, ahead in zip(walls, forward, strict=True):
        for hole in by_wall.get(wall.wall_id, ()):
            sign = 1.0 if ahead else -1.0
            s0, s1 = sorted(line.along(wall.start_m) + sign * a for a in hole.along_m)
            holes.append((s0, s1, *hole.height_m))
            if hole.is_closed:
                leaves.append(_slab(line, s0, s1, hole.height_m, _DOOR_RGB, _DOOR_RGB))
    cuts = _distinct([s for span in spans for s in span] + [s for h in holes for s in h[:2]])
    bodies: list[StaticBody] = []
    solids: list[_Slab] = []
    start, last = 0.0, None
    for a, b in zip(cuts, [*cuts[1:], np.inf], strict=True):
        key = _structure(a, b, walls, spans, forward, holes) if np.isfinite(b) else None
        if key == last:
            continue
        if last is not None:
            height_m, gaps, left, right = last
            for low, high in _solid_ranges(height_m, gaps):
                solids.append(_slab(line, start, a, (low, high), left, right))
        if key is None and solids:
            bodies.append(_body(f"wall-{first + len(bodies)}", "Wall", solids))
            solids = []
        start, last = a, key
    bodies.extend(_body(f"door-{first}-{k}", "Door", [leaf]) for k, leaf in enumerate(leaves))
    return bodies


def _structure(
    a: float,
    b: float,
    walls: list[WallSegment],
    spans: list[tuple[float, ...]],
    forward: list[bool],
    holes: list[tuple[float, float, float, float]],
) -> _Key | None:
    """Height, gaps and the colours left and right of the line between two cuts; None for no wall."""
    middle = (a + b) / 2
    here = [k for k, span in enumerate(spans) if span[0] < middle < span[1]]
    if not here:
        return None
    gaps = tuple(sorted({(h[2], h[3]) for h in holes if h[0] < middle < h[1]}))
    right = next((walls[k].rgb for k in here if forward[k]), _PLAIN)
    left = next((walls[k].rgb for k in here if not forward[k]), _PLAIN)
    return max(walls[k].height_m for k in here), gaps, left, right


def _solid_ranges(height_m: float, gaps: tuple[tuple[float, float], ...]) -> list[tuple[float, float]]:
    """Ranges of [0, height] outside the gaps, without slivers below 5 mm."""
    ranges: list[tuple[float, float]] = []
    low = 0.0
    for gap_low, gap_high in gaps:
        if gap_low - low > 0.005:
            ranges.append((low, min(gap_low, height_m)))
        low = max(low, gap_high)
    if height_m - low > 0.005:
        ranges.append((low, height_m))
    return ranges


def _slab(line: _Line, s0: float, s1: float, z: tuple[float, float], left: Rgb, right: Rgb) -> _Slab:
    half = WALL_THICKNESS_M / 2
    across = np.array([-line.direction[1], line.direction[0]])  # to the left of the line
    a, b = line.origin + s0 * line.direction, line.origin + s1 * line.direction
    ring = np.array([a - half * across, b - half * across, b + half * across, a + half * across])
    low = np.column_stack([ring, np.full(4, z[0])])
    high = np.column_stack([ring, np.full(4, z[1])])
    return _Slab(prism(low, high, right), left)


def _body(body_id: str, object_type: str, slabs: list[_Slab]) -> StaticBody:
    mesh, parts_m = join([slab.solid for slab in slabs])
    row = 0
    for slab in slabs:
        # A prism of four sides lists its wall triangles first: side k has rows k and k + 4.
        mesh.face_rgb[[row + 2, row + 6]] = slab.left_rgb
        row += len(slab.solid.faces)
    return StaticBody(body_id, "wall", object_type, "", "", mesh, parts_m)


def _distinct(values: list[float]) -> list[float]:
    out: list[float] = []
    for value in sorted(values):
        if not out or value - out[-1] > 1e-3:
            out.append(value)
    return out
