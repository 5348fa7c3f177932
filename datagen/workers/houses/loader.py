"""Builds a House in the world frame from a house document of ProcTHOR or Holodeck.

The document is in Unity's frame: left-handed, y up, yaw clockwise seen from above, metres. It is
converted to the world frame (right-handed, z up) by exchanging y and z, which negates yaw. Unknown
keys are ignored: most concern only the simulator of the files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from datagen.workers.furniture.asset_geometry import asset_geometry
from datagen.workers.furniture.assets import Asset
from datagen.workers.furniture.solids import Rgb, join, material_name, material_rgb, placed
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.house import House, Room, StaticBody, Surface
from datagen.workers.houses.plausibility import NO_WALL, refuse_implausible
from datagen.workers.houses.things import Thing, other_surfaces, read_things, top_surfaces
from datagen.workers.houses.walls_and_floors import (
    MAX_CORNERS,
    WINDOW_SILL_M,
    Hole,
    WallSegment,
    clean_polygon,
    floor_solids,
    wall_bodies,
)
from datagen.workers.json_document import EXTENT_M, JsonNode

MAX_ROOMS = 200
MAX_WALLS = 2000
MAX_HOLES = 1000
MAX_FLOOR_M = 0.05  # from the ground
_MAX_HEIGHT_M = 30.0
_ONE_FLOOR = "Keep the ground floor alone, at height 0."


@dataclass(frozen=True, eq=False)
class HouseRecord:
    """A checked house document. `findings` counts by cause what is left out or implausible."""

    rooms: list[Room]
    floors: list[StaticBody]
    walls: dict[str, WallSegment]
    holes: list[Hole]
    things: list[Thing]
    findings: Counter[str]
    materials: dict[Rgb, str]

    @cached_property
    def wall_bodies(self) -> list[StaticBody]:
        """The walls around their holes, which open doors of furniture leave as they are."""
        return wall_bodies(list(self.walls.values()), self.holes)


def read_house(root: JsonNode, assets: Mapping[str, Asset]) -> HouseRecord:
    """The document without meshes: a tenth of the work. Raises InputError that names the JSON path.

    Houses of another schema, without walls of any length, or mostly implausible are refused.
    """
    schema = root.given("metadata", {}).given("schema", "1.")
    if not schema.text().startswith("1."):
        raise schema.error(
            f"unknown schema: version {schema.text()!r}, not 1", "Convert the house to version 1."
        )
    findings = Counter[str]()
    walls, open_walls = _walls(root.get("walls"), findings)
    rooms, floors = _rooms(root.get("rooms"))
    holes = list[Hole]()
    for name in ("doors", "windows"):
        holes += _holes(root.given(name, []), walls, open_walls, name == "doors", findings)
    things = read_things(root, assets, findings)
    refuse_implausible(root, things, rooms, len(holes), findings)
    materials = {
        material_rgb(material, of_floor): material_name(material)
        for part, key, of_floor in (("walls", "material", False), ("rooms", "floorMaterial", True))
        for material in (entry.find(key) for entry in root.get(part).items(MAX_WALLS))
    }
    return HouseRecord(rooms, floors, walls, holes, things, findings, materials)


def build_house(root: JsonNode, house_id: str, digest: str, assets: Mapping[str, Asset]) -> House:
    """The house of one document. Raises InputError as `read_house` does."""
    return _assemble(read_house(root, assets), house_id, digest, is_open=False)


def _assemble(record: HouseRecord, house_id: str, digest: str, is_open: bool) -> House:
    owners = room_ids_at(np.array([t.room_xy for t in record.things]).reshape(-1, 2), record.rooms)
    bodies: list[StaticBody] = []
    surfaces: list[Surface] = []
    for thing, owner in zip(record.things, owners, strict=True):
        mesh, parts_m = placed(*asset_geometry(thing.asset, is_open), thing.T_world_asset)
        object_type, asset_id = thing.asset.object_type, thing.asset.asset_id
        bodies.append(StaticBody(thing.body_id, thing.kind, object_type, asset_id, owner, mesh, parts_m))
        if owner and thing.kind == "furniture" and thing.is_upright:
            surfaces.extend(top_surfaces(thing, owner))
        if is_open and owner and thing.is_upright:
            surfaces.extend(other_surfaces(thing, owner))
    everything = (*record.floors, *record.wall_bodies, *bodies)
    opener = None if is_open else partial(_assemble, record, house_id, digest, is_open=True)
    rooms, places = tuple(record.rooms), tuple(surfaces)
    return House(house_id, digest, rooms, everything, places, record.findings, opener, record.materials)


def room_ids_at(points_m: F64, rooms: list[Room]) -> list[str]:
    """Id of the room that contains each point (N, 2); "" if none does."""
    owners = [""] * len(points_m)
    for room in rooms:
        for k in np.flatnonzero(inside_polygon(points_m, room.polygon_m)):
            owners[k] = owners[k] or room.room_id
    return owners


def _rooms(node: JsonNode) -> tuple[list[Room], list[StaticBody]]:
    rooms: list[Room] = []
    floors: list[StaticBody] = []
    seen: set[str] = set()
    for entry in node.items(MAX_ROOMS):
        room_id = entry.get("id").text()
        if not room_id or room_id in seen:
            raise entry.get("id").error(f"is empty or belongs to two rooms: {room_id!r}")
        seen.add(room_id)
        outline = entry.get("floorPolygon")
        height_m = max(
            (p.get("y").number(-EXTENT_M, EXTENT_M) for p in outline.items(MAX_CORNERS)), key=abs, default=0.0
        )
        if abs(height_m) > MAX_FLOOR_M:
            raise outline.error(f"another floor: it lies at {height_m:g} m, not at 0", _ONE_FLOOR)
        corners = np.array(
            [[p.get(k).number(-EXTENT_M, EXTENT_M) for k in "xz"] for p in outline.items(MAX_CORNERS)],
            np.float64,
        ).reshape(-1, 2)
        polygon_m = clean_polygon(corners)
        if isinstance(polygon_m, str):
            raise outline.error(f"the floor has {polygon_m}")
        rooms.append(Room(room_id, entry.get("roomType").text(), polygon_m))
        mesh, parts_m = join(floor_solids(polygon_m, material_rgb(entry.find("floorMaterial"), True)))
        floors.append(StaticBody(f"floor-{room_id}", "wall", "Floor", "", room_id, mesh, parts_m))
    if not rooms:
        raise node.error("has no rooms", "Remove the house.")
    return rooms, floors


def _walls(node: JsonNode, findings: Counter[str]) -> tuple[dict[str, WallSegment], set[str]]:
    """Walls by id, and the ids of those that are open or left out."""
    walls: dict[str, WallSegment] = {}
    others = set[str]()
    for entry in node.items(MAX_WALLS):
        wall_id = entry.get("id").text()
        if wall_id in walls:
            raise entry.get("id").error(f"belongs to two walls: {wall_id!r}")
        if entry.given("empty", False).value is True:
            others.add(wall_id)
            continue  # a passage between two rooms, listed as a wall
        outline = entry.get("polygon")
        points = [p.point() for p in outline.items(16)]
        if len(points) != 4:
            raise outline.error(f"has {len(points)} corners, not 4")
        # Files list the corners in different orders: the lower two are the ends.
        points.sort(key=lambda p: p[1])
        base_m, height_m = points[0][1], points[3][1] - points[0][1]
        start, end = (points[0][0], points[0][2]), (points[1][0], points[1][2])
        if not 0.1 <= height_m <= _MAX_HEIGHT_M:
            raise outline.error(f"a wall {height_m:g} m high")
        if abs(base_m) > MAX_FLOOR_M:
            raise outline.error(f"another floor: a wall begins at {base_m:g} m, not at 0", _ONE_FLOOR)
        if np.hypot(end[0] - start[0], end[1] - start[1]) < 1e-3:
            others.add(wall_id)
            findings["walls without length"] += 1
            continue
        rgb = material_rgb(entry.find("material"), False)
        walls[wall_id] = WallSegment(wall_id, start, end, height_m, rgb)
    if (lost := findings["walls without length"]) > len(walls):
        raise node.error(
            f"walls without length: {lost} of {lost + len(walls)}", "Correct or remove the house."
        )
    return walls, others


def _holes(
    node: JsonNode,
    walls: Mapping[str, WallSegment],
    open_walls: set[str],
    is_door: bool,
    findings: Counter[str],
) -> list[Hole]:
    """Openings, measured along `wall0`, or along `wall1` from its other end if only `wall1` exists."""
    holes: list[Hole] = []
    for entry in node.items(MAX_HOLES):
        wall0, wall1 = entry.get("wall0").text(), entry.given("wall1", "").text()
        outline = entry.get("holePolygon")
        points = [p.point() for p in outline.items(16)]
        if len(points) < 2:
            raise outline.error(f"has {len(points)} corners, not at least 2")
        low, high = (min(p[0] for p in points), max(p[0] for p in points))
        bottom, top = (min(p[1] for p in points), max(p[1] for p in points))
        if high - low < 0.01 or top - bottom < 0.01:
            raise outline.error("a hole without area")
        wall = walls.get(wall0) or walls.get(wall1)
        if wall is None:
            if open_walls.isdisjoint((wall0, wall1)):
                findings[NO_WALL] += 1
            continue  # a hole in an open wall, or in none
        length = float(np.hypot(wall.end_m[0] - wall.start_m[0], wall.end_m[1] - wall.start_m[1]))
        if wall.wall_id != wall0:
            low, high = length - high, length - low
        low, high = max(low, 0.0), min(high, length)
        if high - low < 0.01:
            raise outline.error("a hole beyond the end of its wall")
        bottom = 0.0 if is_door else max(bottom, WINDOW_SILL_M)
        if is_door and top < 1.0:
            raise outline.error(f"a door {top:g} m high")
        if top <= bottom:
            continue
        room0, room1 = (entry.given(k, "").text() for k in ("room0", "room1"))
        leads_out = is_door and (room0 == room1 or "exterior" in wall0 or "exterior" in wall1)
        holes.append(Hole(wall.wall_id, (low, high), (bottom, min(top, wall.height_m)), leads_out))
    return holes
