"""Objects of a ProcTHOR house document: their poses, what they rest on, and their support surfaces.

An object's `position` is the centre of its bounding box, in Unity's frame (see `loader`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
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
from datagen.workers.furniture.places import floor_around, places_of
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.houses.holodeck import read_holodeck
from datagen.workers.houses.house import BodyKind, Surface
from datagen.workers.json_document import JsonNode

MAX_OBJECTS = 5000
MAX_CHILDREN = 1000
MAX_BODIES = 20_000
_MAX_ANGLE_DEG = 1e6
_UPRIGHT_DEG = 2.0
# Files place objects up to 5 cm above their support and leave the fall to the simulator.
_HANGS_M = 0.12
_SINKS_M = 0.03
_NARROWEST_M = 0.1
# Furniture that begins below this stands on the floor, and one of these sides stands in the way of a robot.
_ON_FLOOR_M, _BULKY_M = 0.1, 0.35
_SWAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Thing:
    """An object of a house document in its place; its body is not built yet."""

    body_id: str
    kind: BodyKind
    asset: Asset
    T_world_asset: F64  # (4, 4), origin at the base
    room_xy: F64  # (2,), decides its room; a child belongs to the room of its support
    is_upright: bool
    above_m: float = 0.0  # of a child: height of its lowest point above the highest level of its support


def read_things(root: JsonNode, assets: Mapping[str, Asset], findings: Counter[str]) -> list[Thing]:
    """Furniture, each piece followed by the small things on it."""
    out: list[Thing] = []
    seen: set[str] = set()
    entries = list(root.get("objects").items(MAX_OBJECTS))
    own = read_holodeck(root, entries)
    for entry in entries if own is None else own.furniture:
        asset = assets.get(entry.get("assetId").text())
        if asset is None and own is not None:
            asset = own.stated_asset(entry)
        if asset is None:
            findings["unknown assets"] += 1
            continue  # with the objects on it, which would float
        T_asset, tilt_deg = _pose(entry, asset)
        x, _, z = entry.get("position").point()
        xy = np.array([x, z])
        is_upright = tilt_deg <= _UPRIGHT_DEG
        out.append(Thing(_new_id(entry, seen), "furniture", asset, T_asset, xy, is_upright))
        children = entry.given("children", []).items(MAX_CHILDREN)
        for child in children if own is None else own.carried[entry.get("id").text()]:
            small = assets.get(child.get("assetId").text())
            if small is None:
                findings["unknown assets"] += 1
            if small is None or _is_inside(child, asset, T_asset):
                continue
            T, tilt_deg = _pose(child, small)
            T, above_m = _rested(T, small, asset, T_asset)
            is_upright = tilt_deg <= _UPRIGHT_DEG
            out.append(Thing(_new_id(child, seen), "small", small, T, xy, is_upright, above_m))
    return out


def _new_id(node: JsonNode, seen: set[str]) -> str:
    body_id = node.get("id").text()
    if body_id in seen:
        raise node.get("id").error(f"belongs to two objects: {body_id!r}")
    if len(seen) >= MAX_BODIES:
        raise node.error(f"has more than {MAX_BODIES} objects", "Remove the house.")
    seen.add(body_id)
    return body_id


def _pose(node: JsonNode, asset: Asset) -> tuple[F64, float]:
    """`T_world_asset` (4, 4), origin at the base, and the angle from upright in degrees."""
    x, y, z = node.get("position").point()
    turn = node.get("rotation")
    pitch, yaw, roll = (turn.get(k).number(-_MAX_ANGLE_DEG, _MAX_ANGLE_DEG) for k in "xyz")
    rotation, tilt_deg = _upright_rotation(yaw + 0.0), 0.0  # adding makes -0.0 the key of 0.0
    if not pitch == roll == 0:
        tilted = unity_rotation(pitch, yaw, roll)
        tilt_deg = float(np.degrees(np.arccos(np.clip(tilted[2, 2], -1.0, 1.0))))
        rotation = rotation if tilt_deg <= _UPRIGHT_DEG else tilted
    T = np.eye(4)
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


def _rested(T: F64, small: Asset, below: Asset, T_below: F64) -> tuple[F64, float]:
    """The pose, lowered (or raised) onto the support's nearest level, and its height above the highest."""
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
        lowest -= gap
    return T, lowest - (T_below[2, 3] + max(levels))


def other_surfaces(thing: Thing, room_id: str) -> list[Surface]:
    """Surfaces of the other kinds of places: of the asset with open doors, and of the floor around it."""
    places = places_of(thing.asset)
    stands = thing.kind == "furniture" and thing.T_world_asset[2, 3] < _ON_FLOOR_M
    if stands and min(thing.asset.size_m) >= _BULKY_M:
        places += (floor_around(thing.asset),)
    out: list[Surface] = []
    for k, place in enumerate(places):
        T = thing.T_world_asset.copy()
        T[:3, 3] += T[:3, :3] @ (*place.rectangle.centre_m, place.height_m)
        if place.kind == "floor":
            T[2, 3] = 0.0
        surface_id, object_type = f"{thing.body_id}/{place.kind}{k}", thing.asset.object_type
        size_m = place.rectangle.size_m
        out.append(Surface(surface_id, thing.body_id, object_type, room_id, T, size_m, place.kind))
    return out


def top_surfaces(thing: Thing, room_id: str) -> list[Surface]:
    """Support surfaces of furniture, in frames that turn with the asset; none for other types."""
    body_id, asset, T = thing.body_id, thing.asset, thing.T_world_asset
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
        out.append(Surface(f"{body_id}/{k}", body_id, asset.object_type, room_id, T_surface, (width, depth)))
    return out
