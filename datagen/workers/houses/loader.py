"""Builds a House in the world frame from a ProcTHOR house document.

The document is in Unity's frame: left-handed, y up, yaw clockwise seen from above, metres. It is
converted to the world frame (right-handed, z up) by exchanging y and z, which negates yaw. An
object's `position` is the centre of its bounding box. Unknown keys are ignored: most concern only
the simulator of the files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from datagen.workers.furniture.asset_table import Asset
from datagen.workers.furniture.colours import material_rgb
from datagen.workers.furniture.solids import join
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.floors import MAX_CORNERS, clean_polygon, floor_solids
from datagen.workers.houses.furniture_bodies import object_bodies
from datagen.workers.houses.house import House, Room, StaticBody
from datagen.workers.houses.walls import WINDOW_SILL_M, Hole, WallSegment, wall_bodies
from datagen.workers.json_document import EXTENT_M, JsonNode

MAX_ROOMS = 200
MAX_WALLS = 2000
MAX_HOLES = 1000
_MAX_HEIGHT_M = 30.0
_DEFAULT_CEILING_M = 2.5


def build_house(root: JsonNode, house_id: str, digest: str, assets: Mapping[str, Asset]) -> House:
    """The house of one document. Raises InputError that names the house and the JSON path."""
    skipped: Counter[str] = Counter()
    walls, room_heights = _walls(root.get("walls"), skipped)
    rooms, floors = _rooms(root.get("rooms"), room_heights)
    holes = [*_holes(root.find("doors"), walls, True), *_holes(root.find("windows"), walls, False)]
    furniture, surfaces = object_bodies(root.get("objects"), assets, skipped)
    owners = room_ids_at(np.array([xy for _, xy in furniture]).reshape(-1, 2), rooms)
    owner_of = {body.body_id: owner for (body, _), owner in zip(furniture, owners, strict=True)}
    bodies = [replace(b, room_id=owner_of[b.body_id]) for b, _ in furniture]
    usable = [replace(s, room_id=owner_of[s.body_id]) for s in surfaces if owner_of[s.body_id]]
    if len(usable) < len(surfaces):
        skipped["surface outside every room"] = len(surfaces) - len(usable)
    everything = (*floors, *wall_bodies(list(walls.values()), holes), *bodies)
    return House(house_id, digest, tuple(rooms), everything, tuple(usable), dict(skipped))


def room_ids_at(points_m: F64, rooms: list[Room]) -> list[str]:
    """Id of the room that contains each point (N, 2); "" if none does."""
    owners = [""] * len(points_m)
    for room in rooms:
        for k in np.flatnonzero(inside_polygon(points_m, room.polygon_m)):
            owners[k] = owners[k] or room.room_id
    return owners


def _rooms(node: JsonNode, heights: Mapping[str, float]) -> tuple[list[Room], list[StaticBody]]:
    rooms: list[Room] = []
    floors: list[StaticBody] = []
    seen: set[str] = set()
    for entry in node.items(MAX_ROOMS):
        room_id = entry.get("id").text()
        if not room_id or room_id in seen:
            raise entry.get("id").error(f"is empty or belongs to two rooms: {room_id!r}")
        seen.add(room_id)
        outline = entry.get("floorPolygon")
        corners = np.array([_ground(p) for p in outline.items(MAX_CORNERS)], np.float64).reshape(-1, 2)
        polygon_m = clean_polygon(corners)
        if isinstance(polygon_m, str):
            raise outline.error(f"the floor has {polygon_m}")
        ceiling_m = heights.get(room_id, max(heights.values(), default=_DEFAULT_CEILING_M))
        rooms.append(Room(room_id, entry.get("roomType").text(), polygon_m, ceiling_m))
        mesh, parts_m = join(floor_solids(polygon_m, material_rgb(entry.find("floorMaterial"), True)))
        floors.append(StaticBody(f"floor-{room_id}", "wall", "Floor", "", room_id, mesh, parts_m))
    if not rooms:
        raise node.error("has no rooms", "Remove the house.")
    return rooms, floors


def _walls(node: JsonNode, skipped: Counter[str]) -> tuple[dict[str, WallSegment], dict[str, float]]:
    """Walls by id and the height of the walls of each room."""
    walls: dict[str, WallSegment] = {}
    heights: dict[str, float] = {}
    for entry in node.items(MAX_WALLS):
        wall_id = entry.get("id").text()
        if wall_id in walls:
            raise entry.get("id").error(f"belongs to two walls: {wall_id!r}")
        empty = entry.find("empty")
        if empty is not None and empty.value is True:
            skipped["open wall"] += 1  # a passage between two rooms, listed as a wall
            continue
        outline = entry.get("polygon")
        points = [p.point() for p in outline.items(16)]
        if len(points) != 4:
            raise outline.error(f"has {len(points)} corners, not 4")
        height_m = max(p[1] for p in points) - min(p[1] for p in points)
        start, end = (points[0][0], points[0][2]), (points[1][0], points[1][2])
        if not 0.1 <= height_m <= _MAX_HEIGHT_M:
            raise outline.error(f"a wall {height_m:g} m high")
        if np.hypot(end[0] - start[0], end[1] - start[1]) < 1e-3:
            skipped["wall without length"] += 1
            continue
        rgb = material_rgb(entry.find("material"), False)
        walls[wall_id] = WallSegment(wall_id, start, end, height_m, rgb)
        room = entry.find("roomId")
        if room is not None:
            heights[room.text()] = max(height_m, heights.get(room.text(), 0.0))
    return walls, heights


def _holes(node: JsonNode | None, walls: Mapping[str, WallSegment], is_door: bool) -> list[Hole]:
    """Openings, measured along `wall0`, or along `wall1` from its other end if only `wall1` exists."""
    holes: list[Hole] = []
    if node is None:
        return holes
    for entry in node.items(MAX_HOLES):
        wall0, wall1 = entry.get("wall0").text(), _text_or_empty(entry.find("wall1"))
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
            continue  # a hole in an open wall
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
        room0, room1 = (_text_or_empty(entry.find(k)) for k in ("room0", "room1"))
        leads_out = is_door and (room0 == room1 or "exterior" in wall0 or "exterior" in wall1)
        holes.append(Hole(wall.wall_id, (low, high), (bottom, min(top, wall.height_m)), leads_out))
    return holes


def _text_or_empty(node: JsonNode | None) -> str:
    return "" if node is None else node.text()


def _ground(node: JsonNode) -> tuple[float, float]:
    return (node.get("x").number(-EXTENT_M, EXTENT_M), node.get("z").number(-EXTENT_M, EXTENT_M))
