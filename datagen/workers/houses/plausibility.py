"""Poses that no furnished house has: counted by cause, and reason to refuse a house of many."""

from __future__ import annotations

from collections import Counter

import numpy as np

from datagen.workers.furniture.assets import CARRYING_TYPES, top_rectangles
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.house import Room
from datagen.workers.houses.things import Thing
from datagen.workers.json_document import JsonNode

# Of the things of a house, doors and windows included. Every one of 2018 houses of the ProcTHOR generator has
# less (tests/workers/houses/test_plausibility.py), and files with another convention for poses have far more.
MOST_IMPLAUSIBLE = 0.1

NO_WALL = "implausible (doors to no wall)"
_SUNK, _FLOATING = "implausible (sunk)", "implausible (floating)"
_OUTSIDE, _OVERLAPPING = "implausible (outside its room)", "implausible (overlapping)"
_OFF_FLOOR_M = 0.05
_OFF_SUPPORT_M = 0.12
_BEYOND_ROOM_M = 0.3
_OVERLAP_M = 0.1
# Furniture that may hang on a wall, and seats that are pushed below tables.
_HUNG = frozenset({"Cabinet", "Shelf", "ShelvingUnit"})
_PUSHED_IN = frozenset({"Chair", "Footstool", "Ottoman", "Stool"})


def refuse_implausible(
    root: JsonNode, things: list[Thing], rooms: list[Room], n_holes: int, findings: Counter[str]
) -> None:
    """Add implausible things to the findings, which have doors without a wall; `n_holes` is of the others.

    Raises InputError beyond MOST_IMPLAUSIBLE.
    """
    furniture = [(thing, _corners(thing)) for thing in things if thing.kind == "furniture"]
    found = Counter(cause for thing in things if (cause := _off_support(thing)))
    found[_OUTSIDE] = sum(_is_outside(corners_m, thing.room_xy, rooms) for thing, corners_m in furniture)
    found[_OVERLAPPING] = _overlapping(furniture)
    findings.update(+found)
    found[NO_WALL] = findings[NO_WALL]
    number, of = found.total(), len(things) + n_holes + found[NO_WALL]
    if number > MOST_IMPLAUSIBLE * of:
        parts = ", ".join(f"{cause.partition('(')[2][:-1]} {count}" for cause, count in (+found).items())
        problem = f"implausible: {number} of {of} things ({parts})"
        raise root.error(problem, "Check units, axes and the point that positions name, or remove the house.")


def _off_support(thing: Thing) -> str:
    """The cause if the thing is neither on the floor, nor on its support, nor hung up; else ""."""
    lowest_m = float(_corners(thing)[:, 2].min())
    if thing.kind == "furniture":
        stands = thing.is_upright and thing.asset.object_type in CARRYING_TYPES - _HUNG
        above_m = lowest_m - _OFF_FLOOR_M if stands else 0.0
    else:
        above_m = thing.above_m - _OFF_SUPPORT_M
    return _SUNK if lowest_m < -_OFF_FLOOR_M else _FLOATING if above_m > 0 else ""


def _corners(thing: Thing) -> F64:
    """Corners (8, 3) of the asset's box, world."""
    x, y, height = thing.asset.halves_m
    box = np.array([[sx * x, sy * y, z] for sx in (-1, 1) for sy in (-1, 1) for z in (0.0, height)])
    return box @ thing.T_world_asset[:3, :3].T + thing.T_world_asset[:3, 3]


def _is_outside(corners_m: F64, centre_m: F64, rooms: list[Room]) -> bool:
    """Whether a box reaches far out of the room that holds its centre, or no room does."""
    polygon = next((r.polygon_m for r in rooms if inside_polygon(centre_m[None], r.polygon_m)[0]), None)
    if polygon is None:
        return True
    points = corners_m[~inside_polygon(corners_m[:, :2], polygon), :2]
    along = np.roll(polygon, -1, axis=0) - polygon  # (K, 2)
    t = ((points[:, None] - polygon) * along).sum(2) / (along**2).sum(1)
    nearest = polygon + np.clip(t, 0.0, 1.0)[..., None] * along
    return bool((np.linalg.norm(points[:, None] - nearest, axis=2).min(1) > _BEYOND_ROOM_M).any())


def _overlapping(furniture: list[tuple[Thing, F64]]) -> int:
    """Pieces on the floor, parallel to the axes, that reach into an earlier one."""
    boxes = np.array(
        [
            (corners_m.min(0), corners_m.max(0))
            for thing, corners_m in furniture
            if thing.is_upright
            and thing.asset.object_type not in _PUSHED_IN
            and len(top_rectangles(thing.asset)) == 1  # not an L, whose corner is free
            and abs(thing.T_world_asset[2, 3]) < _OFF_FLOOR_M
            and np.abs(thing.T_world_asset[:2, :2]).max() > 0.999
        ]
    ).reshape(-1, 2, 3)
    low, high = boxes[:, 0], boxes[:, 1]
    shared = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    return int(np.tril(shared.min(2) > _OVERLAP_M, -1).any(1).sum())
