"""Maps of a floor as robots keep them: what is free, what is occupied, and what nobody knows.

Read as Nav2's map server does (docs.nav2.org/configuration/packages/configuring-map-server.html): a YAML file
names a picture, its resolution, the pose of its lower left corner, and how grey values are meant.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.geometry.mesh import F64
from datagen.workers.image_file import read_grey
from datagen.workers.json_document import JsonNode
from datagen.workers.yaml_file import parse_yaml

FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # as in nav_msgs/OccupancyGrid
_OCCUPIED_PERCENT, _FREE_PERCENT = 65, 25
_MOST_BYTES = 2**20
_FIX = "Give a map.yaml of Nav2's map_saver: image, resolution, origin, negate, occupied_thresh, free_thresh"
# The grey that map_saver writes for unknown cells. Nav2's own default, free_thresh 0.25, reads it as free
# (github.com/SteveMacenski/slam_toolbox/issues/587).
_SAVED_UNKNOWN = 205


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A map of cells (H, W), the first row lowest, in the frame in which frames have their poses."""

    place: str
    cells: np.ndarray[tuple[int, int], np.dtype[np.int8]]  # FREE, OCCUPIED or UNKNOWN
    resolution_m: float
    origin: tuple[float, float, float]  # the lower left corner (m), and the turn of the cells' x axis (rad)
    picture: Path | None = None  # the file of its cells

    def states(self, xy_m: F64) -> np.ndarray[tuple[int], np.dtype[np.int8]]:
        """The cells' states (N,) at positions (N, 2); UNKNOWN beside the map."""
        x, y, turn = self.origin
        rel, c, s = xy_m - [x, y], np.cos(turn), np.sin(turn)
        along = np.stack([c * rel[:, 0] + s * rel[:, 1], c * rel[:, 1] - s * rel[:, 0]]) / self.resolution_m
        column, row = np.floor(along).astype(np.int64)
        height, width = self.cells.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = np.full(len(xy_m), UNKNOWN, np.int8)
        found[inside] = self.cells[row[inside], column[inside]]
        return found


def grid_map(
    place: str, percent: np.ndarray[Any, Any], resolution_m: float, origin: tuple[float, float, float]
) -> OccupancyMap:
    """The map of an OccupancyGrid's values (H, W): percent of being occupied, -1 unknown."""
    cells = np.full((percent.shape[0], percent.shape[1]), UNKNOWN, np.int8)
    cells[percent >= _OCCUPIED_PERCENT] = OCCUPIED
    cells[(percent >= 0) & (percent <= _FREE_PERCENT)] = FREE
    return OccupancyMap(place, cells, resolution_m, origin)


def read_map(path: Path) -> OccupancyMap:
    """The map of a YAML file and the picture that it names. InputError for anything else."""
    document = parse_yaml(read_regular(path, _MOST_BYTES, _FIX), path, _FIX)
    node = JsonNode(str(path), "$", document)
    if not isinstance(document, dict) or "image" not in document:
        raise InputError(path, "image", "is missing", _FIX)
    name = node.get("image").text()
    mode = node.given("mode", "trinary").text()
    if mode not in ("trinary", "scale"):
        raise InputError(path, "mode", f"is {mode}", "Save the map as trinary or scale")
    resolution_m = node.get("resolution").number(0.001, 1.0)
    origin = [value.number(-1e5, 1e5) for value in node.get("origin").items(3)]
    if len(origin) != 3:
        raise InputError(
            path, "origin", f"has {len(origin)} numbers", "Give x, y and yaw of the lower left corner"
        )
    occupied, free = (
        node.given(key, default).number(0.0, 1.0)
        for key, default in (("occupied_thresh", 0.65), ("free_thresh", 0.25))
    )
    negated = node.given("negate", 0).value
    if negated not in (0, 1):
        raise InputError(path, "negate", f"is {negated!r:.80}", "Write 0 or 1")
    grey, alpha = read_grey(picture := path.parent / name)
    dark = grey / 255 if negated else 1 - grey / 255
    cells = np.full(grey.shape, UNKNOWN, np.int8)
    cells[dark > occupied] = OCCUPIED
    cells[dark < free] = FREE
    if mode == "trinary" and not negated:
        cells[grey == _SAVED_UNKNOWN] = UNKNOWN
    if alpha is not None and mode == "scale":
        cells[alpha < 255] = UNKNOWN
    x, y, turn = origin
    return OccupancyMap(str(path), cells[::-1], resolution_m, (x, y, turn), picture)
