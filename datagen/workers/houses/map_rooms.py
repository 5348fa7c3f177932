"""House source `map`: rooms as a robot's occupancy map knows them, and supports from a file beside it.

ROOM.yaml   a map of Nav2's map_saver, and the picture that it names
ROOM.toml   occupied_height_m, and a [[support]] for each table, shelf or counter, in the map's frame

A map knows neither heights nor shapes. Every occupied cell is therefore a wall of one height, and every
unknown cell near the free ones an obstacle that cannot be seen. Cells below a support that are not free end
below its top.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from datagen.schemas.errors import InputError, choices
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import read_regular
from datagen.workers.furniture.solids import ColouredSolid, Rgb, box, join, pick, placed, prism
from datagen.workers.geometry.mesh import F64, Mesh
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.houses.house import House, Room, StaticBody, Surface
from datagen.workers.houses.mesh_geometry import flat_tops
from datagen.workers.houses.walls_and_floors import (
    FLOOR_THICKNESS_M,
    MAX_CORNERS,
    clean_polygon,
    triangles,
    without_straight_corners,
)
from datagen.workers.json_document import EXTENT_M, JsonNode
from datagen.workers.occupancy_map import FREE, OCCUPIED, UNKNOWN, OccupancyMap, read_map
from datagen.workers.source_statement import read_statement

_VERSION = 1
_KEYS = ("name", "height_m", "centre_m", "size_m", "yaw_deg", "polygon_m")
_MAX_CELLS, _MAX_SOLIDS, _MAX_SUPPORTS = 2_000_000, 20_000, 100
_ROOM_M2, _NEAR_M, _UNKNOWN_M, _TOP_M = 1.0, 0.5, 1.0, 0.04
_WALL_RGB: Rgb = (214, 210, 202)
_FLOOR_RGB: Rgb = (178, 160, 138)
_WOOD: tuple[Rgb, ...] = ((164, 122, 82), (126, 88, 58), (196, 160, 116))
_FIX = "Write ROOM.toml next to ROOM.yaml: occupied_height_m, and a [[support]] with height_m for each table"
_OFF = "implausible (supports off the floor)"
Cells = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class _Support:
    """A level top: its outline (K, 2) in the frame of the map's cells, simple and counter-clockwise."""

    name: str
    height_m: float
    outline_m: F64


@dataclass(frozen=True, eq=False)
class MapHouses:
    """The maps of a folder, or one map; a house's id is the name of its files."""

    paths: dict[str, Path]
    digests: dict[str, str]
    digest: str
    statement: Mapping[str, str] = field(default_factory=dict)
    kind: str = "map"

    def house_ids(self) -> list[str]:
        return list(self.paths)

    def load(self, house_id: str) -> House:
        """The house, in the map's frame. Raises InputError that names the file and the field."""
        if house_id not in self.paths:
            raise InputError("map", "", f"has no house {house_id!r}", choices(self.paths, house_id))
        return _house(house_id, self.digests[house_id], *_read(self.paths[house_id]))

    def examine(self, house_id: str) -> Mapping[str, int]:
        """The findings of the house. Raises InputError as `load` does."""
        return self.load(house_id).findings


def open_map(place: str) -> MapHouses:
    """The map of a YAML file, or those of a folder that have a TOML file. InputError if none can be read."""
    path = Path(place).expanduser()
    files = (
        [path] if not path.is_dir() else [p for p in path.glob("*.yaml") if p.with_suffix(".toml").exists()]
    )
    if not place or not files:
        raise InputError(place or "map", "", "has no ROOM.yaml with a ROOM.toml", _FIX)
    odd = next((p for p in files if not p.name.isprintable()), None)
    if odd is not None:
        raise InputError(odd, "", "has a name with unprintable characters", "Rename the file")
    paths, digests, errors = {file.stem: file for file in sorted(files)}, dict[str, str](), list[InputError]()
    for house_id, file in paths.items():
        try:
            known, _, _ = _read(file)
            cells, text = sha256(known.cells.tobytes()).hexdigest(), sha256(_toml(file)).hexdigest()
            found = [cells, known.cells.shape, known.resolution_m, known.origin, text]
        except InputError as error:
            errors.append(error)  # raised again by `load`
            found = [error.problem]
        digests[house_id] = digest_of([_VERSION, found])
    if len(errors) == len(paths):
        raise errors[0]
    folder = path if path.is_dir() else path.parent
    return MapHouses(paths, digests, digest_of([_VERSION, digests]), read_statement(folder))


def _toml(path: Path) -> bytes:
    return read_regular(path.with_suffix(".toml"), 1 << 20, _FIX)


def _read(path: Path) -> tuple[OccupancyMap, float, list[_Support]]:
    """The map, the height of its occupied cells, and its supports."""
    known, place = read_map(path), path.with_suffix(".toml")
    if known.cells.size > _MAX_CELLS:
        problem = f"has {known.cells.size:,} cells, more than {_MAX_CELLS:,}"
        raise InputError(path, "image", problem, "Crop the map to the rooms")
    for state, name in ((FREE, "free"), (OCCUPIED, "occupied")):
        if not (known.cells == state).any():
            problem = f"has no {name} cells"
            raise InputError(path, "image", problem, "Check negate, occupied_thresh and free_thresh")
    try:
        values: dict[str, Any] = tomllib.loads(_toml(path).decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(place, "", f"is not TOML ({error})", _FIX) from None
    root = JsonNode(str(place), "$", values)
    _refuse_others(root, ("occupied_height_m", "support"))
    supports = [_support(node, known) for node in root.get("support").items(_MAX_SUPPORTS)]
    if not supports:
        raise root.get("support").error("lists no support", _FIX)
    return known, root.get("occupied_height_m").number(0.1, 10.0), supports


def _refuse_others(node: JsonNode, keys: tuple[str, ...]) -> None:
    other = (
        next((key for key in node.value if key not in keys), None) if isinstance(node.value, dict) else None
    )
    if other is not None:
        raise node.error(f"has the unknown key {other!r}", choices(keys, other))


def _support(node: JsonNode, known: OccupancyMap) -> _Support:
    height_m = node.get("height_m").number(0.1, 3.0)
    _refuse_others(node, _KEYS)
    name = node.given("name", "support").text()
    polygon = node.find("polygon_m")
    if polygon is not None:
        if node.find("centre_m") is not None or node.find("size_m") is not None:
            raise node.error("has two outlines", "Give polygon_m, or centre_m and size_m")
        corners_m = np.array([p.numbers(2, -EXTENT_M, EXTENT_M) for p in polygon.items(MAX_CORNERS)]).reshape(
            -1, 2
        )
    else:
        yaw = np.deg2rad(node.given("yaw_deg", 0).number(-360.0, 360.0))
        x, y = node.get("centre_m").numbers(2, -EXTENT_M, EXTENT_M)
        half_m = np.array(node.get("size_m").numbers(2, 0.05, 20.0)) / 2
        T = yaw_pose(x, y, 0.0, float(yaw))
        corners_m = (half_m * [(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ T[:2, :2].T + T[:2, 3]
    x, y, yaw = known.origin
    T = yaw_pose(x, y, 0.0, yaw)
    outline_m = clean_polygon((corners_m - T[:2, 3]) @ T[:2, :2])
    if isinstance(outline_m, str):
        raise node.error(f"the outline has {outline_m}")
    return _Support(name, height_m, outline_m)


def _house(house_id: str, digest: str, known: OccupancyMap, wall_m: float, supports: list[_Support]) -> House:
    """The house: all solids are built in the frame of the map's cells, with cells added around it."""
    step_m, findings = known.resolution_m, Counter[str]()
    border = int(np.ceil(_UNKNOWN_M / step_m))
    cells = np.pad(known.cells, border, constant_values=UNKNOWN)
    shift_m = -border * step_m
    below = [_inside(cells.shape, (s.outline_m - shift_m) / step_m) for s in supports]
    free, covered = cells == FREE, np.any(below, axis=0)
    patches, rooms = _rooms(free | covered, free, step_m, shift_m, findings)
    x, y, yaw = known.origin
    T = yaw_pose(x, y, 0.0, yaw)

    def boxes(mask: Cells, z: tuple[float, float], rgb: Rgb) -> list[ColouredSolid]:
        edges_m = np.arange(max(mask.shape) + 1) * step_m + shift_m
        return [
            box((edges_m[x0], edges_m[x1]), (edges_m[y0], edges_m[y1]), z, rgb)
            for (x0, x1), (y0, y1) in _rectangles(mask)
        ]

    floor = boxes(patches > 0, (-FLOOR_THICKNESS_M, 0.0), _FLOOR_RGB)
    walls = boxes((cells == OCCUPIED) & ~covered, (0.0, wall_m), _WALL_RGB)
    near = np.asarray(ndimage.distance_transform_edt(~free)) * step_m <= _UNKNOWN_M
    # Free cells too few for a room are no floor: a base would stand in a pocket that it cannot enter.
    closed = ((cells == UNKNOWN) & near) | (free & (patches == 0))
    hidden = boxes(closed & ~covered, (0.0, wall_m), _WALL_RGB)
    if not rooms or max(len(floor), len(walls) + len(hidden)) > _MAX_SOLIDS:
        problem = f"needs more than {_MAX_SOLIDS:,} boxes" if rooms else "has no free area of 1 m2"
        raise InputError(known.place, "image", problem, "Crop the map to the rooms, and remove single cells")
    mesh, parts_m = placed(*join(walls or hidden), T)
    hidden_parts_m = placed(*join(hidden), T)[1] if walls and hidden else ()
    bodies = [
        StaticBody("floor", "wall", "Floor", "", "", *placed(*join(floor), T)),
        StaticBody("walls", "wall", "Wall", "", "", mesh, (*parts_m, *hidden_parts_m)),
    ]
    surfaces: list[Surface] = []
    for number, (support, own) in enumerate(zip(supports, below, strict=True)):
        around = ndimage.binary_dilation(own, iterations=int(np.ceil(_NEAR_M / step_m)))
        counts = np.bincount(patches[around & free], minlength=len(rooms) + 1)[1:]
        if not counts.any():
            findings[_OFF] += 1
            continue
        room_id, body_id = rooms[int(counts.argmax())].room_id, f"{number}|{support.name}"
        rgb, under_m = pick(_WOOD, support.name), support.height_m - _TOP_M
        solids = [*boxes(own & ~free, (0.0, under_m), rgb), *_top(support, under_m, rgb)]
        solid = placed(*join(solids), T)
        bodies.append(StaticBody(body_id, "furniture", "Table", support.name, room_id, *solid))
        found = _surface(support, T)
        if found is None:
            findings["supports without 0.3 x 0.3 m"] += 1
        else:
            surfaces.append(Surface(f"{body_id}/0", body_id, "Table", room_id, *found))
    if findings[_OFF] > len(supports) / 2:
        problem = f"implausible: {findings[_OFF]} of {len(supports)} supports are off the map's floor"
        raise InputError(
            Path(known.place).with_suffix(".toml"), "support", problem, "Give them in the map's frame"
        )
    rooms = [Room(r.room_id, r.room_type, r.polygon_m @ T[:2, :2].T + T[:2, 3]) for r in rooms]
    return House(house_id, digest, tuple(rooms), tuple(bodies), tuple(surfaces), findings)


def _rooms(
    floor: Cells, free: Cells, step_m: float, shift_m: float, findings: Counter[str]
) -> tuple[npt.NDArray[np.int64], list[Room]]:
    """The room of each cell, from 1 on, and the rooms: connected patches of floor that are large enough."""
    # Imported here: it comes with matplotlib.
    from contourpy import contour_generator

    labels, count = cast(tuple[npt.NDArray[np.int32], int], ndimage.label(floor))
    areas_m2 = np.bincount(labels[free], minlength=count + 1) * step_m**2
    large = [k for k in range(1, count + 1) if areas_m2[k] >= _ROOM_M2]
    if small := count - len(large):
        findings["free areas below 1 m2"] = small
    patches, rooms = np.zeros(floor.shape, np.int64), list[Room]()
    for number, k in enumerate(large, start=1):
        patches[labels == k] = number
        lines = cast(list[F64], contour_generator(z=(labels == k).astype(np.float64)).lines(0.5))
        outer = max(lines, key=lambda line: float(np.prod(np.ptp(line, axis=0))))[:-1]
        x, y = (without_straight_corners(outer) + 0.5).T * step_m + shift_m
        polygon_m = np.column_stack([x, y])
        if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:
            polygon_m = polygon_m[::-1]
        rooms.append(Room(f"room|{number}", "Room", polygon_m))
    return patches, rooms


def _inside(shape: tuple[int, ...], outline: F64) -> Cells:
    """Whether the centre of each cell lies in an outline (K, 2), in cells."""
    mask = np.zeros(shape, np.bool_)
    low, high = np.clip([outline.min(0), outline.max(0) + 1], 0, shape[::-1]).astype(int)
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]]
    mask[low[1] : high[1], low[0] : high[0]] = inside_polygon(
        np.column_stack([x.ravel(), y.ravel()]) + 0.5, outline
    ).reshape(x.shape)
    return mask


def _rectangles(mask: Cells) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Intervals of columns and rows that fill the mask: equal runs of rows that follow each other are one."""
    still: dict[tuple[int, int], int] = {}  # run -> its first row
    for row in range(len(mask) + 1):
        line = mask[row] if row < len(mask) else np.zeros(mask.shape[1], np.bool_)
        ends = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        runs = {(int(a), int(b)) for a, b in ends.reshape(-1, 2)}
        for run in [run for run in still if run not in runs]:
            yield run, (still.pop(run), row)
        for run in sorted(runs):
            still.setdefault(run, row)


def _top(support: _Support, under_m: float, rgb: Rgb) -> list[ColouredSolid]:
    corners = [support.outline_m[list(triangle)] for triangle in triangles(support.outline_m)]
    low, high = np.full((3, 1), under_m), np.full((3, 1), support.height_m)
    return [prism(np.hstack([c, low]), np.hstack([c, high]), rgb) for c in corners]


def _surface(support: _Support, T_world_cells: F64) -> tuple[F64, tuple[float, float]] | None:
    """`T_world_surface` and size of the largest rectangle along the longest side; None for a narrow one."""
    sides_m = np.roll(support.outline_m, -1, axis=0) - support.outline_m
    x, y = sides_m[np.linalg.norm(sides_m, axis=1).argmax()]
    T = T_world_cells @ yaw_pose(0.0, 0.0, support.height_m, float(np.arctan2(y, x)))
    turned = np.column_stack(
        [support.outline_m @ np.array([[x, -y], [y, x]]) / np.hypot(x, y), 0 * sides_m[:, 0]]
    )
    faces = np.array(triangles(support.outline_m), np.int32)
    mesh = Mesh(turned.astype(np.float32), faces, np.zeros((len(faces), 3), np.uint8))
    tops = flat_tops(mesh, -1.0, 1.0)
    if not tops:
        return None
    rectangle = tops[0][1]
    T[:3, 3] += T[:3, :3] @ (*rectangle.centre_m, 0.0)
    return T, rectangle.size_m
