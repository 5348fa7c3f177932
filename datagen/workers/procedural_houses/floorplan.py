"""Floor plans: a rectangle cut into rooms, joined by doors into one connected home.

World x, y; every coordinate is a multiple of 1 mm, so that walls of neighbours meet exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

Rect = tuple[float, float, float, float]  # x0, y0, x1, y1

WALL_HEIGHT_M = 2.6
DOOR_HEIGHT_M = 2.05
_MIN_SIDE_M = {"LivingRoom": 3.2, "Kitchen": 2.8, "Bedroom": 2.8, "Bathroom": 1.9}
_MIN_SHARED_M = 1.3
_CORNER_M = 0.15


@dataclass(frozen=True)
class PlannedRoom:
    """A rectangular room."""

    room_id: str
    room_type: str
    rect: Rect


@dataclass(frozen=True)
class Stretch:
    """A straight piece of a room's wall with one neighbour (None: outside); the room lies to its right."""

    room: int
    start_m: tuple[float, float]
    end_m: tuple[float, float]
    neighbour: int | None

    @property
    def length_m(self) -> float:
        return abs(self.end_m[0] - self.start_m[0]) + abs(self.end_m[1] - self.start_m[1])

    def at(self, along_m: float) -> tuple[float, float]:
        share = along_m / self.length_m
        (x0, y0), (x1, y1) = self.start_m, self.end_m
        return (x0 + share * (x1 - x0), y0 + share * (y1 - y0))


@dataclass(frozen=True)
class Opening:
    """A door or window in a stretch of wall: along it, and in height."""

    stretch: Stretch
    along_m: tuple[float, float]
    height_m: tuple[float, float]
    is_door: bool


@dataclass(frozen=True)
class FloorPlan:
    """Rooms, their walls and the openings in them."""

    rooms: tuple[PlannedRoom, ...]
    stretches: tuple[Stretch, ...]
    openings: tuple[Opening, ...]


def draw_floor_plan(rng: np.random.Generator) -> FloorPlan:
    """A home of two to five rooms with a kitchen; doors join all rooms and one leads outside."""
    while True:
        rooms = _draw_rooms(rng)
        if rooms is None:
            continue
        stretches = _stretches(rooms)
        doors = _doors(rooms, stretches, rng)
        if doors is not None:
            windows = _windows(stretches, doors, rng)
            return FloorPlan(tuple(rooms), tuple(stretches), (*doors, *windows))


def _draw_rooms(rng: np.random.Generator) -> list[PlannedRoom] | None:
    count = int(rng.integers(2, 6))
    area_m2 = count * rng.uniform(12.0, 16.0)
    width = float(np.sqrt(area_m2 * rng.uniform(0.8, 1.7)))
    rects: list[Rect] = [(0.0, 0.0, round(width, 3), round(area_m2 / width, 3))]
    while len(rects) < count:
        largest = max(range(len(rects)), key=lambda k: _area(rects[k]))
        x0, y0, x1, y1 = rects.pop(largest)
        # The last cut leaves a small room for a bathroom.
        share = rng.uniform(0.25, 0.4) if len(rects) == count - 2 and count > 2 else rng.uniform(0.4, 0.6)
        if x1 - x0 > y1 - y0:
            cut = round(x0 + share * (x1 - x0), 3)
            rects += [(x0, y0, cut, y1), (cut, y0, x1, y1)]
        else:
            cut = round(y0 + share * (y1 - y0), 3)
            rects += [(x0, y0, x1, cut), (x0, cut, x1, y1)]
    rects.sort(key=_area, reverse=True)
    # From the largest to the smallest room.
    types = {
        2: ["LivingRoom", "Kitchen"],
        3: ["LivingRoom", "Kitchen", "Bathroom"],
        4: ["LivingRoom", "Bedroom", "Kitchen", "Bathroom"],
        5: ["LivingRoom", "Bedroom", "Kitchen", "Bedroom", "Bathroom"],
    }[count]
    if count == 2 and rng.random() < 0.4:
        types = ["Kitchen", "Bedroom"]
    if count == 3 and rng.random() < 0.5:
        types = ["LivingRoom", "Kitchen", "Bedroom"]
    for rect, kind in zip(rects, types, strict=True):
        if min(rect[2] - rect[0], rect[3] - rect[1]) < _MIN_SIDE_M[kind]:
            return None
    return [PlannedRoom(f"room|{k}", t, r) for k, (r, t) in enumerate(zip(rects, types, strict=True))]


def _area(rect: Rect) -> float:
    return (rect[2] - rect[0]) * (rect[3] - rect[1])


def _stretches(rooms: list[PlannedRoom]) -> list[Stretch]:
    """The walls of every room, cut where the neighbour changes, clockwise seen from above."""
    out: list[Stretch] = []
    for k, room in enumerate(rooms):
        x0, y0, x1, y1 = room.rect
        ring = [(x0, y0), (x0, y1), (x1, y1), (x1, y0)]
        for start, end in zip(ring, [*ring[1:], ring[0]], strict=True):
            axis = 0 if start[1] == end[1] else 1
            low, high = sorted((start[axis], end[axis]))
            marks = {r.rect[i] for r in rooms for i in (axis, axis + 2)}
            cuts = [low, *sorted(m for m in marks if low < m < high), high]
            pieces = list(pairwise(cuts))
            if start[axis] > end[axis]:
                pieces = [(b, a) for a, b in reversed(pieces)]
            out.extend(_joined(k, axis, start[1 - axis], pieces, rooms))
    return out


def _joined(
    room: int, axis: int, level: float, pieces: list[tuple[float, float]], rooms: list[PlannedRoom]
) -> list[Stretch]:
    """Pieces of one side with their neighbours; equal neighbours in a row become one stretch."""
    runs: list[tuple[float, float, int | None]] = []
    for a, b in pieces:
        neighbour = _neighbour(room, axis, level, (a + b) / 2, rooms)
        if runs and runs[-1][2] == neighbour:
            runs[-1] = (runs[-1][0], b, neighbour)
        else:
            runs.append((a, b, neighbour))

    def point(along: float) -> tuple[float, float]:
        return (along, level) if axis == 0 else (level, along)

    return [Stretch(room, point(a), point(b), n) for a, b, n in runs]


def _neighbour(room: int, axis: int, level: float, middle: float, rooms: list[PlannedRoom]) -> int | None:
    for k, other in enumerate(rooms):
        touches = level in (other.rect[1 - axis], other.rect[3 - axis])
        if k != room and touches and other.rect[axis] < middle < other.rect[axis + 2]:
            return k
    return None


def _doors(
    rooms: list[PlannedRoom], stretches: list[Stretch], rng: np.random.Generator
) -> list[Opening] | None:
    """Doors along a spanning tree of the rooms, few through private rooms, and one to the outside."""
    inner = [
        s for s in stretches
        if s.neighbour is not None and s.neighbour > s.room and s.length_m >= _MIN_SHARED_M
    ]  # fmt: skip
    privacy = {"Bathroom": 2.0, "Bedroom": 1.0, "Kitchen": 0.2, "LivingRoom": 0.0}
    weights = [
        privacy[rooms[s.room].room_type] + privacy[rooms[s.neighbour or 0].room_type] + rng.random()
        for s in inner
    ]
    group = list(range(len(rooms)))
    doors: list[Opening] = []
    for k in np.argsort(weights):
        s = inner[k]
        a, b = group[s.room], group[s.neighbour or 0]
        if a != b:
            group = [a if g == b else g for g in group]
            doors.append(_opening(s, rng.uniform(0.88, 1.0), (0.0, DOOR_HEIGHT_M), True, rng))
    outer = [
        s
        for s in stretches
        if s.neighbour is None and s.length_m >= _MIN_SHARED_M
        if rooms[s.room].room_type in ("LivingRoom", "Kitchen")
    ]
    if len(set(group)) > 1 or not outer:
        return None
    way_out = outer[rng.integers(len(outer))]
    return [*doors, _opening(way_out, rng.uniform(0.88, 1.0), (0.0, DOOR_HEIGHT_M), True, rng)]


def _windows(stretches: list[Stretch], doors: list[Opening], rng: np.random.Generator) -> list[Opening]:
    with_door = {d.stretch for d in doors}
    out: list[Opening] = []
    for s in stretches:
        if s.neighbour is None and s not in with_door and s.length_m > 2.0 and rng.random() < 0.7:
            width = rng.uniform(0.9, min(1.8, s.length_m - 0.8))
            sill = rng.uniform(0.9, 1.1)
            out.append(_opening(s, width, (sill, rng.uniform(1.9, 2.2)), False, rng))
    return out


def _opening(
    s: Stretch, width_m: float, height_m: tuple[float, float], is_door: bool, rng: np.random.Generator
) -> Opening:
    start = rng.uniform(_CORNER_M, s.length_m - width_m - _CORNER_M)
    return Opening(s, (round(start, 3), round(start + width_m, 3)), height_m, is_door)
