"""A scene as Holodeck writes it: one JSON file in a folder of its own, objects of Objaverse."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.workers.houses.house_files import xyz

TABLE, SOFA, PICTURE, PLATE = "0" * 32, "1" * 32, "2" * 32, "3" * 32


def wall(room: str, side: str, number: int, start: tuple[float, float], end: tuple[float, float]) -> dict:
    """A wall as a cycle: up at its start, along, and down at its end."""
    corners = [(start, 0.0), (start, 3.0), (end, 3.0), (end, 0.0)]
    return {
        "id": f"wall|{room}|{side}|{number}",
        "roomId": room,
        "material": {"name": "Walldrywall4Tiled"},
        "polygon": [xyz(x, y, z) for (x, z), y in corners],
        "connected_rooms": [],
        "width": abs(end[0] - start[0]) + abs(end[1] - start[1]),
        "height": 3.0,
        "direction": side,
        "segment": [list(start), list(end)],
    }


def piece(
    name: str, asset: str, size_m: tuple[float, float, float], at: tuple[float, float], yaw: int
) -> dict:
    """A piece on the floor: its footprint, in centimetres, is 10 cm larger than it."""
    along, across = (100 * size_m[0] + 10, 100 * size_m[2] + 10)
    x, z = (across / 2, along / 2) if yaw % 180 else (along / 2, across / 2)
    centre = 100 * at[0], 100 * at[1]
    return {
        "assetId": asset, "id": f"{name} (dining room)", "kinematic": True, "object_name": name,
        "position": xyz(at[0], size_m[1] / 2, at[1]), "rotation": xyz(0, yaw, 0), "material": None,
        "roomId": "dining room",
        "vertices": [[centre[0] + i * x, centre[1] + j * z] for i, j in ((1, -1), (1, 1), (-1, 1), (-1, -1))],
    }  # fmt: skip


def scene() -> dict[str, Any]:
    """A room of 6 x 4 m with a table, a sofa, a picture and a plate on the table."""
    room, corners = "dining room", [(0.0, 0.0), (0.0, 4.0), (6.0, 4.0), (6.0, 0.0)]
    walls = [
        wall(room, side, k, corners[k], corners[(k + 1) % 4])
        for k, side in enumerate(("west", "north", "east", "south"))
    ]
    outside = [w | {"id": w["id"] + "|exterior", "polygon": w["polygon"][::-1]} for w in walls]
    floor = [
        piece("dining table-0", TABLE, (1.6, 0.74, 0.9), (3.0, 2.0), 90),
        piece("sofa-0", SOFA, (1.8, 0.8, 0.8), (1.0, 3.4), 180),
    ]
    picture = {
        "assetId": PICTURE, "id": "painting-0 (dining room)", "kinematic": True, "object_name": "painting-0",
        "position": xyz(3.0, 1.6, 3.97), "rotation": xyz(0, 180, 0), "roomId": room,
        "vertices": [[250, 390], [350, 390], [350, 400], [250, 400]],
    }  # fmt: skip
    plate = {
        "assetId": PLATE, "id": "plate-0|dining table-0 (dining room)", "kinematic": False,
        "position": xyz(3.1, 0.755, 2.1), "rotation": xyz(0, 30, 0), "roomId": room,
    }  # fmt: skip
    return {
        "metadata": {"schema": "1.0.0"}, "query": "a dining room", "wall_height": 3.0,
        "rooms": [{"id": room, "roomType": room, "floorMaterial": {"name": "OakWood"},
                   "vertices": corners, "floorPolygon": [xyz(x, 0, z) for x, z in corners]}],
        "walls": walls + outside, "open_walls": {"segments": [], "openWallBoxes": []},
        "doors": [{"id": "door|0|exterior|dining room", "assetId": "Doorway_1", "room0": "exterior",
                   "room1": room, "wall0": outside[3]["id"], "wall1": walls[3]["id"], "openable": False,
                   "holePolygon": [xyz(1.0, 0, 0), xyz(2.0, 2.1, 0)]}],
        "windows": [{"id": "window|0", "room0": room, "room1": room, "roomId": room, "wall0": walls[0]["id"],
                     "wall1": outside[0]["id"], "holePolygon": [xyz(1.0, 1, 0), xyz(2.0, 2, 0)]}],
        "objects": [*floor, picture, plate], "floor_objects": floor, "wall_objects": [picture],
        "small_objects": [plate],
    }  # fmt: skip


def annotations() -> dict[str, Any]:
    """Entries of objathor's annotations.json.gz."""

    def entry(category: str, x: float, y: float, z: float) -> dict:
        box = {"min": xyz(-x / 2, 0, -z / 2), "max": xyz(x / 2, y, z / 2)}
        return {"category": category, "thor_metadata": {"assetMetadata": {"boundingBox": box}}}

    return {
        TABLE: entry("table", 1.6, 0.74, 0.9),
        SOFA: entry("sofa", 1.8, 0.8, 0.8),
        PICTURE: entry("painting", 1.0, 0.7, 0.04),
        PLATE: entry("plate", 0.24, 0.03, 0.24),
    }


def write_scene(folder: Path, document: Any, name: str = "a_dining_room") -> Path:
    """The folder of scenes; each is in a folder named like it and the time."""
    path = folder / f"{name}-2024-08-07" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=4))
    return folder
