"""The embedded houses: drawn by number, written as house documents, read by the same loader."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.identity import canonical_json, digest_of
from datagen.workers.furniture.colours import hash_bytes
from datagen.workers.furniture.support_tops import CARRYING_TYPES, top_height_m, top_rectangles
from datagen.workers.houses.house import House
from datagen.workers.houses.loader import build_house
from datagen.workers.json_document import JsonNode
from datagen.workers.procedural_houses.floorplan import (
    WALL_HEIGHT_M,
    FloorPlan,
    Opening,
    Stretch,
    draw_floor_plan,
)
from datagen.workers.procedural_houses.furniture_placement import ROOM_FURNISHERS, Furnisher
from datagen.workers.procedural_houses.furniture_sizes import BUILTIN_ASSETS
from datagen.workers.procedural_houses.room_layout import layout_of

# Part of the digest: raise it whenever the same number would give another house.
GENERATOR_VERSION = 1
_DEFAULT_COUNT = 400
_MOST = 100_000
_HOUSES_KEPT = 64
# A first word of the seed of its own, so that no other use of small numbers draws the same stream.
_SEED = 0x486F757365
_FLOORS = ("OakWood", "DarkWoodParquet", "GreyConcrete", "BeigeTile", "WalnutWood", "Carpet")
_WALLS = ("Eggshell", "WhitePlaster", "BlueDrywall", "GreenDrywall", "TanPlaster", "GreyDrywall")


@dataclass(frozen=True)
class BuiltinHouses:
    """`count` generated homes, `builtin-0000` and on. A longer collection begins with a shorter one."""

    count: int
    digest: str
    kind: str = "builtin"

    def house_ids(self) -> list[str]:
        """Ids by number."""
        return [_house_id(k) for k in range(self.count)]

    def load(self, house_id: str) -> House:
        """Draw and build the house; the last ones are kept for all that this process opens."""
        number = house_id.removeprefix("builtin-")
        if not number.isdecimal() or int(number) >= self.count or _house_id(int(number)) != house_id:
            fix = f"Give one of builtin-0000 to {_house_id(self.count - 1)}."
            raise InputError("builtin", "", f"has no house {house_id!r}", fix)
        return _house(int(number))


def open_builtin(text: str) -> BuiltinHouses:
    """The built-in houses; the text is how many, 400 if empty."""
    if text and not (text.isdecimal() and len(text) < 7 and 1 <= int(text) <= _MOST):
        raise InputError("builtin", "", f"{text!r} is not a number", f"Give 1 to {_MOST}, as builtin:400.")
    count = int(text) if text else _DEFAULT_COUNT
    sizes = {a.asset_id: [a.object_type, *a.size_m] for a in BUILTIN_ASSETS.values()}
    return BuiltinHouses(count, digest_of(["builtin-houses", GENERATOR_VERSION, count, sizes]))


@lru_cache(maxsize=_HOUSES_KEPT)
def _house(number: int) -> House:
    document, house_id = house_document(number), _house_id(number)
    digest = hash_bytes(canonical_json(document)).hex()
    return build_house(JsonNode(f"builtin ({house_id})", "$", document), house_id, digest, BUILTIN_ASSETS)


def house_document(number: int) -> dict[str, Any]:
    """The house of that number as a ProcTHOR document, the same on every machine.

    Resampled until it has a top of at least 0.5 x 0.4 m, 0.3 to 1.2 m high.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([_SEED, number])))
    while True:
        plan = draw_floor_plan(rng)
        objects = _furniture(plan, rng)
        if any(_is_usable(o["assetId"]) for o in objects):
            return _document(plan, objects, rng)


def _house_id(number: int) -> str:
    return f"builtin-{number:04d}"


def _furniture(plan: FloorPlan, rng: np.random.Generator) -> list[dict[str, Any]]:
    objects: list[dict[str, Any]] = []
    for index, room in enumerate(plan.rooms):
        furnisher = Furnisher(layout_of(plan, index), rng)
        ROOM_FURNISHERS[room.room_type](furnisher)
        furnisher.decorate()
        objects.extend(furnisher.objects)
    return objects


def _is_usable(asset_id: str) -> bool:
    asset = BUILTIN_ASSETS[asset_id]
    sides = sorted(top_rectangles(asset)[0].size_m)
    low_enough = 0.3 <= top_height_m(asset) <= 1.2
    return asset.object_type in CARRYING_TYPES and low_enough and sides[0] >= 0.4 and sides[1] >= 0.5


def _document(plan: FloorPlan, objects: list[dict[str, Any]], rng: np.random.Generator) -> dict[str, Any]:
    floors = [_FLOORS[rng.integers(len(_FLOORS))] for _ in plan.rooms]
    paints = [_WALLS[rng.integers(len(_WALLS))] for _ in plan.rooms]
    rooms: list[dict[str, Any]] = []
    for room, floor in zip(plan.rooms, floors, strict=True):
        x0, y0, x1, y1 = room.rect
        polygon = [_point(x, 0.0, y) for x, y in ((x0, y0), (x0, y1), (x1, y1), (x1, y0))]
        names = {"id": room.room_id, "roomType": room.room_type}
        rooms.append({**names, "floorPolygon": polygon, "floorMaterial": {"name": floor}})
    walls: list[dict[str, Any]] = []
    for s in plan.stretches:
        inside = f"room|{s.room}"
        walls.append(_wall(_wall_id(s), inside, s.start_m, s.end_m, paints[s.room]))
        if s.neighbour is None:
            walls.append(_wall(_other_side_id(s), "exterior", s.end_m, s.start_m, "Eggshell"))
    return {
        "metadata": {"schema": "1.0.0", "generator": GENERATOR_VERSION},
        "rooms": rooms,
        "walls": walls,
        "doors": [_opening(o, k) for k, o in enumerate(plan.openings) if o.is_door],
        "windows": [_opening(o, k) for k, o in enumerate(plan.openings) if not o.is_door],
        "objects": objects,
    }


def _point(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _wall_id(s: Stretch) -> str:
    return f"wall|{s.room}|" + "|".join(f"{v:.2f}" for v in (*s.start_m, *s.end_m))


def _other_side_id(s: Stretch) -> str:
    if s.neighbour is None:
        return "wall|exterior|" + "|".join(f"{v:.2f}" for v in (*s.end_m, *s.start_m))
    return _wall_id(Stretch(s.neighbour, s.end_m, s.start_m, s.room))


def _wall(
    wall_id: str, room_id: str, start_m: tuple[float, float], end_m: tuple[float, float], paint: str
) -> dict[str, Any]:
    corners = [_point(x, height_m, y) for height_m in (0.0, WALL_HEIGHT_M) for x, y in (start_m, end_m)]
    return {"id": wall_id, "roomId": room_id, "polygon": corners, "material": {"name": paint}}


def _opening(o: Opening, number: int) -> dict[str, Any]:
    s = o.stretch
    corners = [_point(along, height, 0.0) for along, height in zip(o.along_m, o.height_m, strict=True)]
    return {
        "id": f"{'door' if o.is_door else 'window'}|{number}",
        "room0": f"room|{s.room}",
        "room1": f"room|{s.room if s.neighbour is None else s.neighbour}",
        "wall0": _wall_id(s),
        "wall1": _other_side_id(s),
        "holePolygon": corners,
    }
