"""Hand-made houses in the ProcTHOR layout, whose geometry is known, and ways to write them."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

SIZES: dict[str, dict[str, Any]] = {
    "Table_1": {"objectType": "DiningTable", "size": [1.2, 0.75, 0.8], "surface_height_m": 0.755},
    "Countertop_L_8x6": {"objectType": "CounterTop", "size": [2.4, 0.94, 1.8], "surface_height_m": 0.943},
    "Countertop_C_10x8": {"objectType": "CounterTop", "size": [3.0, 0.94, 2.4], "surface_height_m": 0.943},
    "Chair_1": {"objectType": "Chair", "size": [0.5, 0.9, 0.6]},
    "Fridge_1": {"objectType": "Fridge", "size": [0.9, 1.8, 0.7]},
    "Mug_1": {"objectType": "Mug", "size": [0.1, 0.1, 0.1]},
    "Card_1": {"objectType": "CreditCard", "size": [0.09, 0.0, 0.05]},
    "Bat_1": {"objectType": "BaseballBat", "size": [0.08, 0.96, 0.08]},
    "Desk_9": {"objectType": "Desk", "size": [1.4, 1.6, 0.6], "surface_height_m": 0.8},
}


def xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def thing(name: str, asset: str, position: dict[str, float], yaw: float = 0.0, **more: Any) -> dict[str, Any]:
    return {"id": name, "assetId": asset, "position": position, "rotation": xyz(0, yaw, 0), **more}


def wall(name: str, room: str, start: tuple[float, float], end: tuple[float, float]) -> dict[str, Any]:
    low = [xyz(start[0], 0, start[1]), xyz(end[0], 0, end[1])]
    return {
        "id": name, "roomId": room, "polygon": [*low, *({**p, "y": 2.5} for p in low)],
        "material": {"name": "PureWhite", "color": {"r": 0.5, "g": 0.25, "b": 1.0}},
    }  # fmt: skip


def two_rooms() -> dict[str, Any]:
    """Two rooms of 4 x 3 m beside each other (Unity x, z), a door between them and a way out.

    Room walls run clockwise seen from above in the world. The inner wall is at x = 4.
    """
    return {
        "_id": "two-rooms",
        "rooms": [
            {"id": "room|0", "roomType": "Kitchen", "floorMaterial": {"name": "OakWood"},
             "floorPolygon": [xyz(0, 0, 0), xyz(0, 0, 3), xyz(4, 0, 3), xyz(4, 0, 0)]},
            {"id": "room|1", "roomType": "Bedroom", "floorMaterial": {"name": "Carpet"},
             "floorPolygon": [xyz(4, 0, 0), xyz(4, 0, 3), xyz(8, 0, 3), xyz(8, 0, 0)]},
        ],
        "walls": [
            wall("w|0|west", "room|0", (0, 0), (0, 3)),
            wall("w|0|north", "room|0", (0, 3), (4, 3)),
            wall("w|0|east", "room|0", (4, 3), (4, 0)),
            wall("w|0|south", "room|0", (4, 0), (0, 0)),
            wall("w|1|west", "room|1", (4, 0), (4, 3)),
            wall("w|1|north", "room|1", (4, 3), (8, 3)),
            wall("w|1|east", "room|1", (8, 3), (8, 0)),
            wall("w|1|south", "room|1", (8, 0), (4, 0)),
            wall("w|exterior|south", "exterior", (0, 0), (4, 0)),
            wall("w|exterior|east", "exterior", (8, 0), (8, 3)),
        ],
        "doors": [
            {"id": "door|0|1", "room0": "room|0", "room1": "room|1", "wall0": "w|0|east", "wall1": "w|1|west",
             "assetId": "Doorframe_1", "holePolygon": [xyz(0.4, 0, 0), xyz(1.4, 2.1, 0)]},
            {"id": "door|0|0", "room0": "room|0", "room1": "room|0", "wall0": "w|0|south",
             "wall1": "w|exterior|south", "holePolygon": [xyz(1, 0, 0), xyz(2, 2.1, 0)]},
        ],
        "windows": [
            {"id": "window|1|1", "room0": "room|1", "room1": "room|1", "wall0": "w|1|east",
             "wall1": "w|exterior|east", "holePolygon": [xyz(1, 1, 0), xyz(2, 2, 0)]},
        ],
        "objects": [
            thing("0|table", "Table_1", xyz(1.5, 0.375, 2.0), 90, children=[
                thing("0|mug", "Mug_1", xyz(1.5, 0.86, 2.0)),
                thing("0|card", "Card_1", xyz(1.4, 0.76, 1.8)),
            ]),
        ],
    }  # fmt: skip


def write_houses(folder: Path, houses: list[Any], sizes: Any = SIZES, name: str = "houses.jsonl.gz") -> Path:
    """The folder with the houses, one a line, and the size table; lines may be given as bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [h if isinstance(h, bytes) else json.dumps(h).encode() for h in houses]
    data = b"\n".join(lines) + b"\n"
    (folder / name).write_bytes(gzip.compress(data, mtime=0) if name.endswith(".gz") else data)
    if sizes is not None:
        (folder / "asset_sizes.json").write_text(json.dumps(sizes))
    return folder
