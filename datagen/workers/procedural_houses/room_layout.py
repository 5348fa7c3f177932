"""Free space of one room: spots that neither block doors nor cut the room in two."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from datagen.workers.furniture.assets import Asset, top_rectangles
from datagen.workers.procedural_houses.floorplan import FloorPlan, Opening, PlannedRoom, Rect

# Type: width, depth, height in metres, and the share by which variants differ from it.
_SIZES: dict[str, tuple[float, float, float, float]] = {
    "AlarmClock": (0.14, 0.06, 0.12, 0.1),
    "Apple": (0.08, 0.08, 0.075, 0.1),
    "ArmChair": (0.82, 0.84, 0.86, 0.06),
    "Bed": (1.50, 2.05, 0.95, 0.05),
    "Book": (0.16, 0.23, 0.035, 0.2),
    "Bottle": (0.08, 0.08, 0.26, 0.15),
    "Bowl": (0.17, 0.17, 0.07, 0.15),
    "Box": (0.40, 0.32, 0.28, 0.15),
    "Candle": (0.06, 0.06, 0.12, 0.3),
    "Chair": (0.46, 0.48, 0.88, 0.05),
    "CoffeeMachine": (0.24, 0.34, 0.36, 0.1),
    "CoffeeTable": (1.10, 0.62, 0.43, 0.08),
    "Cup": (0.085, 0.085, 0.10, 0.15),
    "Desk": (1.30, 0.65, 0.75, 0.06),
    "DeskLamp": (0.22, 0.22, 0.46, 0.1),
    "DiningTable": (1.45, 0.90, 0.75, 0.08),
    "Dresser": (1.15, 0.48, 0.88, 0.08),
    "FloorLamp": (0.40, 0.40, 1.65, 0.06),
    "Fridge": (0.70, 0.70, 1.80, 0.04),
    "GarbageCan": (0.34, 0.30, 0.52, 0.15),
    "HousePlant": (0.42, 0.42, 0.85, 0.2),
    "Kettle": (0.20, 0.22, 0.22, 0.1),
    "Laptop": (0.34, 0.28, 0.24, 0.05),
    "LaundryHamper": (0.45, 0.36, 0.62, 0.1),
    "Microwave": (0.52, 0.38, 0.30, 0.06),
    "Mug": (0.12, 0.085, 0.095, 0.1),
    "Painting": (0.80, 0.03, 0.60, 0.2),
    "Pillow": (0.44, 0.32, 0.14, 0.1),
    "Plate": (0.25, 0.25, 0.025, 0.1),
    "Pot": (0.30, 0.24, 0.15, 0.1),
    "RemoteControl": (0.05, 0.17, 0.022, 0.1),
    "ShelvingUnit": (0.85, 0.34, 1.60, 0.1),
    "SideTable": (0.46, 0.42, 0.54, 0.08),
    "SoapBottle": (0.08, 0.07, 0.19, 0.1),
    "Sofa": (2.00, 0.90, 0.84, 0.06),
    "Stove": (0.60, 0.60, 0.92, 0.0),
    "TVStand": (1.40, 0.42, 0.52, 0.08),
    "Television": (1.10, 0.22, 0.70, 0.08),
    "TissueBox": (0.23, 0.12, 0.10, 0.1),
    "Toaster": (0.28, 0.18, 0.20, 0.1),
    "Toilet": (0.40, 0.70, 0.80, 0.04),
    "Vase": (0.15, 0.15, 0.24, 0.2),
    "WallCabinet": (0.60, 0.34, 0.65, 0.0),
    "WashingMachine": (0.60, 0.60, 0.86, 0.0),
}
_VARIANTS = 3

COUNTER_HEIGHT_M = 0.92
_COUNTER_DEPTH_M = 0.61


def _variants() -> dict[str, Asset]:
    out: dict[str, Asset] = {}
    for kind, (width, depth, height, spread) in _SIZES.items():
        for k in range(_VARIANTS):
            scale = 1.0 + spread * (k - 1)
            size_m = (round(width * scale, 3), round(depth * scale, 3), round(height * scale, 3))
            out[f"{kind}_{k}"] = Asset(f"{kind}_{k}", kind, size_m)
    return out


def _fixed() -> list[Asset]:
    counters = [
        Asset(f"Counter_I_{round(10 * w)}", "CounterTop", (w, _COUNTER_DEPTH_M, COUNTER_HEIGHT_M))
        for w in (1.2, 1.8, 2.4)
    ]
    corners = [
        Asset(f"Counter_L_{round(10 * w)}x{round(10 * d)}", "CounterTop", (w, d, COUNTER_HEIGHT_M))
        for w in (1.8, 2.4, 3.0) for d in (1.2, 1.8)
    ]  # fmt: skip
    sinks = [
        Asset("Sink_counter", "Sink", (0.50, 0.40, 0.12)),
        Asset("Sink_pedestal", "Sink", (0.56, 0.46, 1.00)),
    ]
    return [*counters, *corners, *sinks]


BUILTIN_ASSETS: dict[str, Asset] = {**_variants(), **{a.asset_id: a for a in _fixed()}}


def variants_of(kind: str) -> list[Asset]:
    """The variants of a type."""
    return [BUILTIN_ASSETS[f"{kind}_{k}"] for k in range(_VARIANTS)]


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
        at_doors = {
            int(regions[np.argmin(np.abs(xs - x)), np.argmin(np.abs(ys - y))]) for x, y in self.door_points
        }
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
