"""Poses that no furnished house has: counted by cause, and reason to refuse a house of many."""

from __future__ import annotations

from collections import Counter
from itertools import product

import numpy as np

from datagen.workers.furniture.assets import CARRYING_TYPES, top_rectangles
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import following, inside_polygon
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
_UNIT_BOX = np.array(list(product((-1.0, 1.0), (-1.0, 1.0), (0.0, 1.0))))
# Furniture that may hang on a wall, and seats that are pushed below tables.
_HUNG = frozenset({"Cabinet", "Shelf", "ShelvingUnit"})
_PUSHED_IN = frozenset({"Chair", "Footstool", "Ottoman", "Stool"})


def refuse_implausible(
    root: JsonNode, things: list[Thing], rooms: list[Room], n_holes: int, findings: Counter[str]
) -> None:
    """Add implausible things to the findings, which have doors without a wall; `n_holes` is of the others.

    Raises InputError beyond MOST_IMPLAUSIBLE.
    """
    boxes = list(zip(things, _corners(things), strict=True))
    furniture = [(thing, corners_m) for thing, corners_m in boxes if thing.kind == "furniture"]
    found = Counter(cause for thing, corners_m in boxes if (cause := _off_support(thing, corners_m)))
    found[_OUTSIDE] = _outside(furniture, rooms)
    found[_OVERLAPPING] = _overlapping(furniture)
    findings.update(+found)
    found[NO_WALL] = findings[NO_WALL]
    number, of = found.total(), len(things) + n_holes + found[NO_WALL]
    if number > MOST_IMPLAUSIBLE * of:
        parts = ", ".join(f"{cause.partition('(')[2][:-1]} {count}" for cause, count in (+found).items())
        problem = f"implausible: {number} of {of} things ({parts})"
        raise root.error(problem, "Check units, axes and the point that positions name, or remove the house.")


def _off_support(thing: Thing, corners_m: F64) -> str:
    """The cause if the thing is neither on the floor, nor on its support, nor hung up; else ""."""
    lowest_m = float(corners_m[:, 2].min())
    if thing.kind == "furniture":
        stands = thing.is_upright and thing.asset.object_type in CARRYING_TYPES - _HUNG
        above_m = lowest_m - _OFF_FLOOR_M if stands else 0.0
    else:
        above_m = thing.above_m - _OFF_SUPPORT_M
    return _SUNK if lowest_m < -_OFF_FLOOR_M else _FLOATING if above_m > 0 else ""


def _corners(things: list[Thing]) -> F64:
    """Corners (N, 8, 3) of the assets' boxes, world."""
    sizes_m = np.array([thing.asset.halves_m for thing in things]).reshape(-1, 1, 3)
    T = np.array([thing.T_world_asset for thing in things]).reshape(-1, 4, 4)
    return (_UNIT_BOX * sizes_m) @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]


def _outside(furniture: list[tuple[Thing, F64]], rooms: list[Room]) -> int:
    """Pieces that reach far out of the first room that holds their centre, or have none."""
    centres_m = np.array([thing.room_xy for thing, _ in furniture]).reshape(-1, 2)
    corners_m = np.array([corners_m[:, :2] for _, corners_m in furniture]).reshape(-1, 8, 2)
    homeless, outside = np.ones(len(furniture), np.bool_), 0
    for polygon in (room.polygon_m for room in rooms):
        own = homeless & inside_polygon(centres_m, polygon)
        homeless &= ~own
        points = corners_m[own].reshape(-1, 2)
        along = following(polygon) - polygon  # (K, 2)
        t = ((points[:, None] - polygon) * along).sum(2) / (along**2).sum(1)
        nearest = polygon + np.clip(t, 0.0, 1.0)[..., None] * along
        beyond = np.linalg.norm(points[:, None] - nearest, axis=2).min(1) > _BEYOND_ROOM_M
        outside += int((beyond & ~inside_polygon(points, polygon)).reshape(-1, 8).any(1).sum())
    return outside + int(homeless.sum())


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
