"""Furniture for the rooms of a floor plan: groups that belong together, placed by trial."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from datagen.workers.furniture.assets import Asset, top_height_m, top_rectangles
from datagen.workers.furniture.furniture_shapes import SOFA_SEAT_SHARE, seat_height_m
from datagen.workers.procedural_houses.floorplan import WALL_HEIGHT_M
from datagen.workers.procedural_houses.room_layout import (
    BUILTIN_ASSETS,
    COUNTER_HEIGHT_M,
    RoomLayout,
    Spot,
    spot_at,
    variants_of,
)

# Small objects on furniture, by the type of room.
_SMALL: dict[str, tuple[str, ...]] = {
    "Kitchen": ("Apple", "Bottle", "Bowl", "Cup", "Mug", "Plate", "Pot", "Vase"),
    "LivingRoom": ("Book", "Bowl", "Candle", "Mug", "RemoteControl", "TissueBox", "Vase"),
    "Bedroom": ("AlarmClock", "Book", "Candle", "Mug", "TissueBox", "Vase"),
    "Bathroom": ("Candle", "Cup", "SoapBottle", "TissueBox"),
}
_CLUTTER_GAP_M = 0.04
_EDGE_M = 0.03

Placed = tuple[Spot, dict[str, Any]]  # furniture, and its entry in the house document


@dataclass(eq=False)
class Furnisher:
    """Furnishes one room; `objects` are entries of a house document."""

    layout: RoomLayout
    rng: np.random.Generator
    objects: list[dict[str, Any]] = field(default_factory=list)

    def one_of(self, kind: str) -> Asset:
        """A random variant of a type."""
        options = variants_of(kind)
        return options[self.rng.integers(len(options))]

    def add(self, spot: Spot, base_m: float = 0.0) -> dict[str, Any]:
        """Add and return an entry at the spot, `base_m` above the floor, without marking it as taken."""
        room = self.layout.room.room_id.split("|")[1]
        entry = _entry(f"{room}|{len(self.objects)}", spot.asset, (spot.x, spot.y), base_m, spot.yaw_deg)
        self.objects.append(entry)
        return entry

    def place(
        self, spots: list[Spot], front_m: float = 0.0, is_tall: bool = False, is_partner: bool = False
    ) -> Placed | None:
        for spot in spots:
            if self.layout.fits(spot, is_partner, is_tall):
                self.layout.take(spot, front_m)
                return spot, self.add(spot)
        return None

    def at_wall(self, kind: str, front_m: float = 0.0, is_tall: bool = False) -> Placed | None:
        """Place a variant of the type with its back at a wall; None if none fits."""
        return self.place(self.layout.wall_spots(self.one_of(kind), self.rng), front_m, is_tall)

    def put_on(
        self, below: Placed, asset: Asset, right_m: float, front_m: float, height_m: float | None = None
    ) -> None:
        """Put an asset on furniture at a point of its frame; `height_m` None is the height of the top."""
        spot, entry = below
        base_m = top_height_m(spot.asset) if height_m is None else height_m
        children: list[dict[str, Any]] = entry["children"]
        child_id = f"{entry['id']}|{len(children)}"
        children.append(_entry(child_id, asset, spot.local(right_m, front_m), base_m, spot.yaw_deg))

    def clutter(self, below: Placed, most: int, taken: Sequence[tuple[float, float, float]] = ()) -> None:
        """Put up to `most` small objects on furniture; `taken` are circles (right, front, radius)."""
        circles = list(taken)
        kinds = _SMALL[self.layout.room.room_type]
        rectangles = top_rectangles(below[0].asset)
        for _ in range(int(self.rng.integers(1, most + 1))):
            asset = self.one_of(kinds[self.rng.integers(len(kinds))])
            radius = float(np.hypot(*asset.size_m[:2])) / 2
            r = rectangles[self.rng.integers(len(rectangles))]
            low = np.array([r.x[0], r.y[0]]) + radius + _EDGE_M
            high = np.array([r.x[1], r.y[1]]) - radius - _EDGE_M
            if (low >= high).any():
                continue
            right, front = (float(v) for v in self.rng.uniform(low, high))
            apart = (np.hypot(right - a, front - b) > radius + c + _CLUTTER_GAP_M for a, b, c in circles)
            if all(apart):
                circles.append((right, front, radius))
                self.put_on(below, asset, right, front)

    def add_pillows(self, sofa: Placed) -> None:
        asset = sofa[0].asset
        for side in (-1.0, 1.0):
            if self.rng.random() < 0.6:
                seat_m = seat_height_m(asset, SOFA_SEAT_SHARE)
                self.put_on(sofa, self.one_of("Pillow"), side * 0.25 * asset.size_m[0], 0.05, seat_m)

    def decorate(self) -> None:
        """Add a picture, a plant and a lamp at random, where they fit."""
        if self.rng.random() < 0.8:
            self._hang_picture()
        if self.rng.random() < 0.7:
            self.at_wall("HousePlant", is_tall=True)
        if self.layout.room.room_type != "Kitchen" and self.rng.random() < 0.7:
            self.at_wall("FloorLamp", is_tall=True)

    def _hang_picture(self) -> None:
        picture = self.one_of("Painting")
        base_m = float(self.rng.uniform(1.45, 1.6))
        for spot in self.layout.wall_spots(picture, self.rng):
            if self.layout.is_wall_free(spot) and not self.layout.is_behind_tall(spot):
                self.add(spot, base_m)
                self.layout.windows.append(spot.rects[0])  # keeps tall furniture away
                return


def _entry(name: str, asset: Asset, xy: tuple[float, float], base_m: float, yaw_deg: float) -> dict[str, Any]:
    """An object of a house document (Unity frame): y is up, `position` is the centre of the box."""
    return {
        "id": name,
        "assetId": asset.asset_id,
        "position": {"x": xy[0], "y": base_m + asset.size_m[2] / 2, "z": xy[1]},
        "rotation": {"x": 0.0, "y": yaw_deg, "z": 0.0},
        "kinematic": True,
        "children": [],
    }


def kitchen(f: Furnisher) -> None:
    """A counter with a sink in a corner or along a wall, cupboards above, fridge, stove and table."""
    corners = [a for a in BUILTIN_ASSETS.values() if a.asset_id.startswith("Counter_L")]
    straight = [a for a in BUILTIN_ASSETS.values() if a.asset_id.startswith("Counter_I")]
    spots: list[Spot] = []
    if f.rng.random() < 0.65:
        for k in f.rng.permutation(len(corners)):
            spots += f.layout.corner_spots(corners[k], f.rng)
    for asset in reversed(straight):
        spots += f.layout.wall_spots(asset, f.rng, 12)
    run = f.place(spots, front_m=0.6)
    if run is not None:
        _equip(f, run)
    f.at_wall("Fridge", front_m=0.6, is_tall=True)
    f.at_wall("Stove", front_m=0.6)
    dining(f)
    f.at_wall("GarbageCan")


def _equip(f: Furnisher, run: Placed) -> None:
    """Sink, appliances and small objects on a counter, and cupboards over its back run."""
    spot, _ = run
    back = top_rectangles(spot.asset)[0]
    depth = spot.asset.size_m[1]
    low = back.x[0]
    high = back.x[1] - (0.62 if len(top_rectangles(spot.asset)) > 1 else 0.0)
    centre = back.centre_m[1]
    sink_at = float(f.rng.uniform(low + 0.3, high - 0.3))
    f.put_on(run, BUILTIN_ASSETS["Sink_counter"], sink_at, centre)
    taken = [(sink_at, centre, 0.33)]
    for kind in ("Microwave", "CoffeeMachine", "Toaster", "Kettle"):
        asset = f.one_of(kind)
        half = asset.size_m[0] / 2
        right = float(f.rng.uniform(back.x[0] + half + _EDGE_M, back.x[1] - half - _EDGE_M))
        front = back.y[0] + asset.size_m[1] / 2 + 0.04
        radius = float(np.hypot(*asset.size_m[:2])) / 2
        if f.rng.random() < 0.5 and all(np.hypot(right - a, front - b) > radius + c for a, b, c in taken):
            f.put_on(run, asset, right, front)
            taken.append((right, front, radius))
    f.clutter(run, 8, taken)
    cupboards: list[Spot] = []
    for k in range(int((back.x[1] - back.x[0]) // 0.62)):
        asset = BUILTIN_ASSETS["WallCabinet_1"]
        xy = spot.local(back.x[0] + 0.31 + 0.62 * k, -depth / 2 + asset.size_m[1] / 2)
        hung = spot_at(asset, *xy, spot.yaw_deg)
        if f.layout.is_wall_free(hung) and COUNTER_HEIGHT_M + 0.5 + asset.size_m[2] < WALL_HEIGHT_M:
            cupboards.append(hung)
    for hung in cupboards:
        f.add(hung, COUNTER_HEIGHT_M + 0.5)
        f.layout.windows.append(hung.rects[0])  # keeps tall furniture away


def dining(f: Furnisher, keeps_fronts_free: bool = False) -> bool:
    """A table in the open with chairs along its sides that face it; False where none fits.

    In a kitchen the chairs may occupy the zone in front of the counter.
    """
    best: tuple[Spot, list[Spot]] | None = None
    chair = f.one_of("Chair")
    for kind in f.rng.permutation(3):
        table = variants_of("DiningTable")[kind]
        for spot in f.layout.open_spots(table, f.rng, 30):
            if not f.layout.fits(spot, ignore_kept=not keeps_fronts_free):
                continue
            chairs = [s for s in _seats(spot, chair) if f.layout.fits(s, ignore_kept=True)]
            if best is None or len(chairs) > len(best[1]):
                best = (spot, chairs)
    if best is None or len(best[1]) < 2:
        return False
    placed = f.place([best[0]], is_partner=True)
    if placed is not None:
        f.clutter(placed, 4)
        for spot in best[1]:
            f.place([spot], is_partner=True)
    return placed is not None


def _seats(spot: Spot, chair: Asset) -> list[Spot]:
    """Two chairs on each long side of a table, facing it."""
    width, depth, _ = spot.asset.size_m
    out: list[Spot] = []
    for side, turned in ((1.0, 180.0), (-1.0, 0.0)):
        for along in (-0.24 * width, 0.24 * width):
            xy = spot.local(along, side * (depth / 2 + chair.size_m[1] / 2 + 0.04))
            out.append(spot_at(chair, *xy, spot.yaw_deg + turned))
    return out


def living_room(f: Furnisher) -> None:
    """A sofa that faces a television across a coffee table, shelves and an armchair."""
    for _ in range(12):
        if _television_corner(f):
            break
    f.at_wall("ShelvingUnit", front_m=0.4, is_tall=True)
    if f.rng.random() < 0.7:
        f.at_wall("ArmChair", front_m=0.4)
    side_table = f.at_wall("SideTable")
    if side_table is not None:
        f.put_on(side_table, f.one_of("DeskLamp"), 0.0, 0.0)
    if f.rng.random() < 0.5:
        dining(f, keeps_fronts_free=True)
    elif f.rng.random() < 0.6:
        _chest(f)


def _television_corner(f: Furnisher) -> bool:
    stand, sofa, coffee = f.one_of("TVStand"), f.one_of("Sofa"), f.one_of("CoffeeTable")
    for spot in f.layout.wall_spots(stand, f.rng, 12):
        if not f.layout.fits(spot):
            continue
        away = float(f.rng.uniform(1.9, 2.6)) + stand.size_m[1] / 2 + sofa.size_m[1] / 2
        seat = spot_at(sofa, *spot.local(0.0, away), spot.yaw_deg + 180.0)
        if not f.layout.fits(seat):
            continue
        f.layout.take(spot, away - (stand.size_m[1] + sofa.size_m[1]) / 2)  # the view stays free
        below = (spot, f.add(spot))
        f.put_on(below, f.one_of("Television"), 0.0, -0.02)
        f.layout.take(seat)
        f.add_pillows((seat, f.add(seat)))
        between = spot.local(0.0, away - sofa.size_m[1] / 2 - 0.4 - coffee.size_m[1] / 2)
        table = f.place([spot_at(coffee, *between, spot.yaw_deg)], is_partner=True)
        if table is not None:
            f.clutter(table, 3)
        return True
    return False


def bedroom(f: Furnisher) -> None:
    """A bed with its head at a wall and tables on both sides, a chest, a desk with its chair."""
    bed = f.place(f.layout.wall_spots(f.one_of("Bed"), f.rng, 40))
    if bed is not None:
        spot = bed[0]
        width, depth, _ = spot.asset.size_m
        for side in (-1.0, 1.0):
            side_table = f.one_of("SideTable")
            right = side * (width / 2 + side_table.size_m[0] / 2 + 0.05)
            xy = spot.local(right, -depth / 2 + side_table.size_m[1] / 2)
            placed = f.place([spot_at(side_table, *xy, spot.yaw_deg)])
            if placed is not None and f.rng.random() < 0.6:
                f.put_on(placed, f.one_of("DeskLamp"), 0.0, -0.05)
            elif placed is not None:
                f.clutter(placed, 2)
    _chest(f)
    work_place(f)
    if f.rng.random() < 0.5:
        f.at_wall("ShelvingUnit", is_tall=True)
    if f.rng.random() < 0.4:
        f.at_wall("LaundryHamper")


def work_place(f: Furnisher) -> None:
    """A desk at a wall with a laptop, a lamp, and a chair that faces it."""
    desk = f.at_wall("Desk", front_m=0.7)
    if desk is None:
        return
    spot = desk[0]
    width, depth, _ = spot.asset.size_m
    corner = (-width / 2 + 0.18, -depth / 2 + 0.18)
    has_lamp = f.rng.random() < 0.6
    if has_lamp:
        f.put_on(desk, f.one_of("DeskLamp"), *corner)
    f.clutter(desk, 3, [(*corner, 0.16)] if has_lamp else ())
    chair = f.one_of("Chair")
    xy = spot.local(-0.1 * width, depth / 2 + chair.size_m[1] / 2 + 0.05)
    f.place([spot_at(chair, *xy, spot.yaw_deg + 180.0)], is_partner=True)


def _chest(f: Furnisher) -> None:
    chest = f.at_wall("Dresser", front_m=0.6)
    if chest is not None:
        f.clutter(chest, 3)


def bathroom(f: Furnisher) -> None:
    """Toilet, washbasin, and further furniture that fits."""
    f.at_wall("Toilet", front_m=0.5)
    f.place(f.layout.wall_spots(BUILTIN_ASSETS["Sink_pedestal"], f.rng), front_m=0.5)
    if f.rng.random() < 0.7:
        f.at_wall("WashingMachine", front_m=0.5)
    side_table = f.at_wall("SideTable")
    if side_table is not None:
        f.clutter(side_table, 2)
    f.at_wall("GarbageCan")


ROOM_FURNISHERS: dict[str, Callable[[Furnisher], None]] = {
    "Bathroom": bathroom,
    "Bedroom": bedroom,
    "Kitchen": kitchen,
    "LivingRoom": living_room,
}
