"""A room as a robot's occupancy map has it: walls, a table of which only the legs are seen, and a counter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from datagen.workers.occupancy_map import FREE, OCCUPIED, UNKNOWN

GREY = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}  # as map_saver writes them
STEP_M = 0.05
YAML = "image: {name}.pgm\nmode: trinary\nresolution: 0.05\norigin: [{origin}]\nnegate: 0\n"
YAML += "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
TABLE = '[[support]]\nname = "table"\nheight_m = 0.74\ncentre_m = [2.5, 2.0]\nsize_m = [1.4, 0.8]\n'
COUNTER = '[[support]]\nname = "counter"\nheight_m = 0.92\n'
COUNTER += "polygon_m = [[0.1, 3.3], [3.0, 3.3], [3.0, 3.9], [0.1, 3.9]]\n"
TOML = f"occupied_height_m = 2.4\n{TABLE}{COUNTER}"


def room_cells() -> np.ndarray:
    """Cells (80, 100) of a room of 5 x 4 m within walls of 10 cm, the first row lowest."""
    cells = np.full((84, 104), UNKNOWN, np.int8)
    cells[:80, :100] = OCCUPIED
    cells[2:78, 2:98] = FREE
    for x in (36, 37, 62, 63):
        for y in (32, 33, 46, 47):
            cells[y, x] = OCCUPIED  # the table's legs
    cells[66:78, 2:60] = UNKNOWN  # the counter: its front alone is seen
    cells[66, 2:60] = OCCUPIED
    return cells


def write_map(
    folder: Path, cells: np.ndarray, toml: str = TOML, origin: str = "0, 0, 0", name: str = "lab"
) -> Path:
    """A map of Nav2's map_saver and its supports; the first row of `cells` is the lowest."""
    folder.mkdir(parents=True, exist_ok=True)
    grey = np.vectorize(GREY.get)(cells).astype(np.uint8)
    Image.fromarray(grey[::-1]).save(folder / f"{name}.pgm")
    (folder / f"{name}.yaml").write_text(YAML.format(origin=origin, name=name))
    (folder / f"{name}.toml").write_text(toml)
    return folder / f"{name}.yaml"
