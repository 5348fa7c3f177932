"""Builds a House in the world frame from a ProcTHOR house document.

The document is in Unity's frame: left-handed, y up, yaw clockwise seen from above, metres. It is
converted to the world frame (right-handed, z up) by exchanging y and z, which negates yaw. An
object's `position` is the centre of its bounding box. Unknown keys are ignored: most concern only
the simulator of the files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from datagen.workers.furniture.asset_geometry import asset_geometry
from datagen.workers.furniture.assets import (
    CARRYING_TYPES,
    Asset,
    hutch_depth_m,
    top_height_m,
    top_rectangles,
)
from datagen.workers.furniture.solids import join, material_rgb, placed
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.house import BodyKind, House, Room, StaticBody, Surface
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
_MAX_HEIGHT_M = 30.0


def build_house(root: JsonNode, house_id: str, digest: str, assets: Mapping[str, Asset]) -> House:
    """The house of one document. Raises InputError that names the house and the JSON path."""
    walls = _walls(root.get("walls"))
    rooms, floors = _rooms(root.get("rooms"))
    holes = [*_holes(root.find("doors"), walls, True), *_holes(root.find("windows"), walls, False)]
    furniture, surfaces = object_bodies(root.get("objects"), assets)
    owners = room_ids_at(np.array([xy for _, xy in furniture]).reshape(-1, 2), rooms)
    owner_of = {body.body_id: owner for (body, _), owner in zip(furniture, owners, strict=True)}
    bodies = [replace(b, room_id=owner_of[b.body_id]) for b, _ in furniture]
    usable = [replace(s, room_id=owner_of[s.body_id]) for s in surfaces if owner_of[s.body_id]]
    everything = (*floors, *wall_bodies(list(walls.values()), holes), *bodies)
    return House(house_id, digest, tuple(rooms), everything, tuple(usable))


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
        corners = np.array([_ground(p) for p in outline.items(MAX_CORNERS)], np.float64).reshape(-1, 2)
        polygon_m = clean_polygon(corners)
        if isinstance(polygon_m, str):
            raise outline.error(f"the floor has {polygon_m}")
        rooms.append(Room(room_id, entry.get("roomType").text(), polygon_m))
        mesh, parts_m = join(floor_solids(polygon_m, material_rgb(entry.find("floorMaterial"), True)))
        floors.append(StaticBody(f"floor-{room_id}", "wall", "Floor", "", room_id, mesh, parts_m))
    if not rooms:
        raise node.error("has no rooms", "Remove the house.")
    return rooms, floors


def _walls(node: JsonNode) -> dict[str, WallSegment]:
    """Walls by id."""
    walls: dict[str, WallSegment] = {}
    for entry in node.items(MAX_WALLS):
        wall_id = entry.get("id").text()
        if wall_id in walls:
            raise entry.get("id").error(f"belongs to two walls: {wall_id!r}")
        empty = entry.find("empty")
        if empty is not None and empty.value is True:
            continue  # a passage between two rooms, listed as a wall
        outline = entry.get("polygon")
        points = [p.point() for p in outline.items(16)]
        if len(points) != 4:
            raise outline.error(f"has {len(points)} corners, not 4")
        height_m = max(p[1] for p in points) - min(p[1] for p in points)
        start, end = (points[0][0], points[0][2]), (points[1][0], points[1][2])
        if not 0.1 <= height_m <= _MAX_HEIGHT_M:
            raise outline.error(f"a wall {height_m:g} m high")
        if np.hypot(end[0] - start[0], end[1] - start[1]) < 1e-3:
            continue
        rgb = material_rgb(entry.find("material"), False)
        walls[wall_id] = WallSegment(wall_id, start, end, height_m, rgb)
    return walls


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


MAX_OBJECTS = 5000
MAX_CHILDREN = 1000
MAX_BODIES = 20_000
_MAX_ANGLE_DEG = 1e6
_UPRIGHT_DEG = 2.0
# Files place objects up to 5 cm above their support and leave the fall to the simulator.
_HANGS_M = 0.12
_SINKS_M = 0.03
_NARROWEST_M = 0.1
_SWAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


def object_bodies(
    node: JsonNode, assets: Mapping[str, Asset]
) -> tuple[list[tuple[StaticBody, F64]], list[Surface]]:
    """Bodies, each with the point (2,) that decides its room, and support surfaces.

    `room_id` is still empty in both. A child belongs to the room of its support.
    """
    out: list[tuple[StaticBody, F64]] = []
    surfaces: list[Surface] = []
    seen: set[str] = set()
    for entry in node.items(MAX_OBJECTS):
        asset = assets.get(entry.get("assetId").text())
        if asset is None:
            continue  # with the objects on it, which would float
        T_asset, tilt_deg = _pose(entry, asset)
        xy = _centre_xy(entry)
        body = _body(entry, asset, T_asset, "furniture", seen)
        out.append((body, xy))
        if tilt_deg <= _UPRIGHT_DEG:
            surfaces.extend(_surfaces(body.body_id, asset, T_asset))
        for child in _children(entry):
            small = assets.get(child.get("assetId").text())
            if small is None or _is_inside(child, asset, T_asset):
                continue
            T = _rested(_pose(child, small)[0], small, asset, T_asset)
            out.append((_body(child, small, T, "small", seen), xy))
    return out, surfaces


def _children(entry: JsonNode) -> Iterator[JsonNode]:
    children = entry.find("children")
    return iter(()) if children is None else children.items(MAX_CHILDREN)


def _body(node: JsonNode, asset: Asset, T: F64, kind: BodyKind, seen: set[str]) -> StaticBody:
    body_id = node.get("id").text()
    if body_id in seen:
        raise node.get("id").error(f"belongs to two objects: {body_id!r}")
    if len(seen) >= MAX_BODIES:
        raise node.error(f"has more than {MAX_BODIES} objects", "Remove the house.")
    seen.add(body_id)
    mesh, parts_m = placed(*asset_geometry(asset), T)
    return StaticBody(body_id, kind, asset.object_type, asset.asset_id, "", mesh, parts_m)


def _pose(node: JsonNode, asset: Asset) -> tuple[F64, float]:
    """`T_world_asset` (4, 4), origin at the base, and the angle from upright in degrees."""
    x, y, z = node.get("position").point()
    turn = node.get("rotation")
    pitch, yaw, roll = (turn.get(k).number(-_MAX_ANGLE_DEG, _MAX_ANGLE_DEG) for k in "xyz")
    upright = _upright_rotation(yaw + 0.0)  # adding makes -0.0 the key of 0.0
    rotation = upright if pitch == roll == 0 else unity_rotation(pitch, yaw, roll)
    tilt_deg = float(np.degrees(np.arccos(np.clip(rotation[2, 2], -1.0, 1.0))))
    T = np.eye(4)
    if tilt_deg <= _UPRIGHT_DEG:
        rotation = upright
    T[:3, :3] = rotation
    T[:3, 3] = np.array([x, z, y]) - rotation @ (0.0, 0.0, asset.size_m[2] / 2)
    return T, tilt_deg


@lru_cache(maxsize=256)  # most objects have one of four angles
def _upright_rotation(yaw_deg: float) -> F64:
    rotation = unity_rotation(0.0, yaw_deg, 0.0)
    rotation.setflags(write=False)
    return rotation


def unity_rotation(x_deg: float, y_deg: float, z_deg: float) -> F64:
    """World rotation (3, 3) of Unity's Euler angles: about z, then x, then y, all fixed axes."""
    (cx, cy, cz), (sx, sy, sz) = (f(np.deg2rad([x_deg, y_deg, z_deg])) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return _SWAP @ about_y @ about_x @ about_z @ _SWAP


def _centre_xy(node: JsonNode) -> F64:
    x, _, z = node.get("position").point()
    return np.array([x, z])


def _is_inside(node: JsonNode, below: Asset, T_below: F64) -> bool:
    """Whether an object's centre lies within a part of its support, as food in a closed fridge."""
    x, y, z = node.get("position").point()
    local = (np.array([x, z, y]) - T_below[:3, 3]) @ T_below[:3, :3]
    low, high = _part_boxes(below)
    return bool(((low < local) & (local < high)).all(1).any())


@lru_cache(maxsize=4096)
def _part_boxes(asset: Asset) -> tuple[F32, F32]:
    """Lowest and highest corners (P, 3) of the asset's parts."""
    _, parts_m = asset_geometry(asset)
    corners = [(part.min(0), part.max(0)) for part in parts_m]
    low, high = np.array(corners, np.float32).reshape(-1, 2, 3).transpose(1, 0, 2)
    return low, high


def _rested(T: F64, small: Asset, below: Asset, T_below: F64) -> F64:
    """The pose, lowered (or raised) onto the nearest level of the support."""
    mesh, _ = asset_geometry(small)
    lowest = float((mesh.vertices_m @ T[2, :3]).min() + T[2, 3])
    levels = {top_height_m(below), *below.levels_m}
    if below.rest_height_m is not None:
        levels.add(below.rest_height_m)
    gaps = [lowest - (T_below[2, 3] + level) for level in levels]
    gap = min(gaps, key=abs)
    if -_SINKS_M < gap < _HANGS_M:
        T = T.copy()
        T[2, 3] -= gap
    return T


def _surfaces(body_id: str, asset: Asset, T: F64) -> list[Surface]:
    """Support surfaces of furniture, in frames that turn with the asset; none for other types."""
    if asset.object_type not in CARRYING_TYPES:
        return []
    out: list[Surface] = []
    for k, rectangle in enumerate(top_rectangles(asset)):
        width, depth = rectangle.size_m
        cx, cy = rectangle.centre_m
        if k == 0:
            hutch = hutch_depth_m(asset)
            cy, depth = cy + hutch / 2, depth - hutch
        if min(width, depth) < _NARROWEST_M:
            continue
        T_surface = T.copy()
        T_surface[:3, 3] = T[:3, :3] @ (cx, cy, top_height_m(asset)) + T[:3, 3]
        out.append(Surface(f"{body_id}/{k}", body_id, asset.object_type, "", T_surface, (width, depth)))
    return out
