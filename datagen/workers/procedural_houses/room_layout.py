"""Free space of one room: spots that neither block doors nor cut the room in two."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from datagen.workers.furniture.asset_table import Asset
from datagen.workers.furniture.support_tops import top_rectangles
from datagen.workers.geometry.mesh import F64
from datagen.workers.procedural_houses.floorplan import FloorPlan, Opening, PlannedRoom, Rect

_WALL_GAP_M = 0.02
_CELL_M = 0.1
# Radius of a body that moves through the room, and depth of the free zone at a door.
_BODY_RADIUS_M = 0.28
_DOOR_ZONE_M = 0.9
_GAP_M = 0.03
_CHEST_M = 1.3

# Unity yaw by wall side: south, west, north, east; furniture faces the room.
_YAW_DEG = (0.0, 90.0, 180.0, 270.0)


@dataclass(frozen=True)
class Spot:
    """A position for one asset: centre (x, y), Unity yaw in degrees, and the rectangles it covers."""

    asset: Asset
    x: float
    y: float
    yaw_deg: float
    rects: tuple[Rect, ...]

    def local(self, right_m: float, front_m: float) -> tuple[float, float]:
        """World x, y of a point `right_m` to the right of and `front_m` in front of the centre."""
        t = np.deg2rad(self.yaw_deg)
        return (
            self.x + right_m * float(np.cos(t)) + front_m * float(np.sin(t)),
            self.y - right_m * float(np.sin(t)) + front_m * float(np.cos(t)),
        )


def spot_at(asset: Asset, x: float, y: float, yaw_deg: float) -> Spot:
    """The asset centred at (x, y), turned by a multiple of 90 degrees."""
    bare = Spot(asset, x, y, yaw_deg % 360.0, ())
    rects: list[Rect] = []
    for r in top_rectangles(asset):
        (xa, ya), (xb, yb) = bare.local(r.x[0], r.y[0]), bare.local(r.x[1], r.y[1])
        rects.append((min(xa, xb), min(ya, yb), max(xa, xb), max(ya, yb)))
    return Spot(asset, x, y, bare.yaw_deg, tuple(rects))


@dataclass(eq=False)
class RoomLayout:
    """Occupied space of a room. `solid` are footprints, `kept` are zones that stay free."""

    room: PlannedRoom
    inner: Rect
    door_zones: list[Rect]
    door_points: list[tuple[float, float]]
    windows: list[Rect]
    solid: list[Rect] = field(default_factory=list)
    kept: list[Rect] = field(default_factory=list)
    tall: list[Rect] = field(default_factory=list)

    def fits(self, spot: Spot, ignore_kept: bool = False, is_tall: bool = False) -> bool:
        """Whether the spot is free and the doors of the room stay joined by a path."""
        i = self.inner
        zones = self.door_zones + ([] if ignore_kept else self.kept) + (self.windows if is_tall else [])
        for r in spot.rects:
            if r[0] < i[0] - 1e-9 or r[1] < i[1] - 1e-9 or r[2] > i[2] + 1e-9 or r[3] > i[3] + 1e-9:
                return False
            if any(_overlap(r, s, _GAP_M) for s in self.solid) or any(_overlap(r, z, 0.0) for z in zones):
                return False
        return self._is_joined_with(spot.rects)

    def is_wall_free(self, spot: Spot) -> bool:
        """Whether the wall at the spot has no door, window or hanging object."""
        return not any(_overlap(spot.rects[0], z, 0.0) for z in [*self.door_zones, *self.windows])

    def is_behind_tall(self, spot: Spot) -> bool:
        """Whether furniture taller than a person's chest covers the spot."""
        return any(_overlap(spot.rects[0], r, 0.0) for r in self.tall)

    def take(self, spot: Spot, front_m: float = 0.0) -> None:
        """Occupy the spot and keep a zone `front_m` deep in front of it free."""
        self.solid.extend(spot.rects)
        if spot.asset.size_m[2] > _CHEST_M:
            self.tall.extend(spot.rects)
        if front_m > 0:
            self.kept.extend(_front_zone(r, spot.yaw_deg, front_m) for r in spot.rects[:1])

    def wall_spots(self, asset: Asset, rng: np.random.Generator, tries: int = 24) -> list[Spot]:
        """Spots with the back at a wall, in random order; a third of them in corners."""
        width, depth, _ = asset.size_m
        x0, y0, x1, y1 = self.inner
        out: list[Spot] = []
        for _ in range(tries):
            side = int(rng.integers(4))
            share = rng.random()
            share = (0.0 if rng.random() < 0.5 else 1.0) if rng.random() < 0.35 else share
            along = width / 2 + share * ((x1 - x0 if side % 2 == 0 else y1 - y0) - width)
            x, y = {
                0: (x0 + along, y0 + depth / 2),
                1: (x0 + depth / 2, y0 + along),
                2: (x0 + along, y1 - depth / 2),
                3: (x1 - depth / 2, y0 + along),
            }[side]
            out.append(spot_at(asset, x, y, _YAW_DEG[side]))
        return out

    def corner_spots(self, asset: Asset, rng: np.random.Generator) -> list[Spot]:
        """The four spots with the back at a wall and the right side in its corner, shuffled."""
        width, depth, _ = asset.size_m
        x0, y0, x1, y1 = self.inner
        centres = [
            (x1 - width / 2, y0 + depth / 2),
            (x0 + depth / 2, y0 + width / 2),
            (x0 + width / 2, y1 - depth / 2),
            (x1 - depth / 2, y1 - width / 2),
        ]
        # Looking away from the wall, +x (right) is: east, south, west, north.
        spots = [spot_at(asset, *centres[k], _YAW_DEG[k]) for k in range(4)]
        return [spots[k] for k in rng.permutation(4)]

    def open_spots(self, asset: Asset, rng: np.random.Generator, tries: int = 24) -> list[Spot]:
        """Spots anywhere in the room, turned by 0 or 90 degrees."""
        x0, y0, x1, y1 = self.inner
        return [
            spot_at(asset, rng.uniform(x0, x1), rng.uniform(y0, y1), 90.0 * int(rng.integers(2)))
            for _ in range(tries)
        ]

    def _is_joined_with(self, extra: tuple[Rect, ...]) -> bool:
        x0, y0, x1, y1 = self.inner
        xs = np.arange(x0 + _CELL_M / 2, x1, _CELL_M)
        ys = np.arange(y0 + _CELL_M / 2, y1, _CELL_M)
        free_x = (xs > x0 + _BODY_RADIUS_M) & (xs < x1 - _BODY_RADIUS_M)
        free_y = (ys > y0 + _BODY_RADIUS_M) & (ys < y1 - _BODY_RADIUS_M)
        free = free_x[:, None] & free_y[None]
        for a0, b0, a1, b1 in [*self.solid, *extra]:
            in_x = (xs > a0 - _BODY_RADIUS_M) & (xs < a1 + _BODY_RADIUS_M)
            in_y = (ys > b0 - _BODY_RADIUS_M) & (ys < b1 + _BODY_RADIUS_M)
            free &= ~(in_x[:, None] & in_y[None])
        regions = cast(npt.NDArray[np.int32], cast(Any, ndimage.label(free))[0])
        at_doors = {_region_at(regions, xs, ys, p) for p in self.door_points}
        return 0 not in at_doors and len(at_doors) <= 1


def layout_of(plan: FloorPlan, index: int) -> RoomLayout:
    """The empty room with the zones of its doors and windows."""
    room = plan.rooms[index]
    g = _WALL_GAP_M
    x0, y0, x1, y1 = room.rect
    inner = (x0 + g, y0 + g, x1 - g, y1 - g)
    own = [o for o in plan.openings if index in (o.stretch.room, o.stretch.neighbour)]
    doors = [o for o in own if o.is_door]
    zones = [_opening_zone(o, inner, _DOOR_ZONE_M) for o in doors]
    points = [_door_point(o, inner) for o in doors]
    windows = [_opening_zone(o, inner, 0.4) for o in own if not o.is_door]
    return RoomLayout(room, inner, zones, points, windows)


def _opening_zone(opening: Opening, inner: Rect, depth_m: float) -> Rect:
    """The rectangle within the room in front of an opening."""
    (xa, ya), (xb, yb) = (opening.stretch.at(a) for a in opening.along_m)
    zone = (min(xa, xb), min(ya, yb), max(xa, xb), max(ya, yb))
    dx, dy = (0.05, depth_m) if ya == yb else (depth_m, 0.05)
    x0, y0, x1, y1 = zone[0] - dx, zone[1] - dy, zone[2] + dx, zone[3] + dy
    return (max(x0, inner[0]), max(y0, inner[1]), min(x1, inner[2]), min(y1, inner[3]))


def _door_point(opening: Opening, inner: Rect) -> tuple[float, float]:
    x, y = opening.stretch.at(sum(opening.along_m) / 2)
    m = _BODY_RADIUS_M + _CELL_M
    return (float(np.clip(x, inner[0] + m, inner[2] - m)), float(np.clip(y, inner[1] + m, inner[3] - m)))


def _region_at(regions: npt.NDArray[np.int32], xs: F64, ys: F64, point: tuple[float, float]) -> int:
    return int(regions[np.argmin(np.abs(xs - point[0])), np.argmin(np.abs(ys - point[1]))])


def _front_zone(rect: Rect, yaw_deg: float, depth_m: float) -> Rect:
    x0, y0, x1, y1 = rect
    side = round(yaw_deg / 90) % 4
    return {
        0: (x0, y1, x1, y1 + depth_m),
        1: (x1, y0, x1 + depth_m, y1),
        2: (x0, y0 - depth_m, x1, y0),
        3: (x0 - depth_m, y0, x0, y1),
    }[side]


def _overlap(a: Rect, b: Rect, gap_m: float) -> bool:
    return a[0] < b[2] + gap_m and b[0] < a[2] + gap_m and a[1] < b[3] + gap_m and b[1] < a[3] + gap_m
