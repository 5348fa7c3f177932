"""Make the pictures of the documents, on the built-in world.

    python -m scripts.pictures [FOLDER [NAME...]]        (make pictures; FOLDER is docs/images)

A test makes each of them again and compares it with the one that is kept.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from PIL import Image

from datagen import cli

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
GRID = ("--candidates-per-scene", "grid")
NEAR = ("--candidates", "in-range")
ROBOTS = ("stretch3", "tiago-pro", "ur5", "pr2", "fetch")
SMALL_PX, QUALITY = 880, 65  # width of the robots' pictures, and quality of their compression


def _trial(robot: str) -> list[tuple[str, ...]]:
    few = ("--n", "6", "--candidates-per-scene", "6", "--seed", "4")
    return [
        ("submit", "sim", *few, *NEAR, "--config", "run.toml", "--robot", robot, "--out", "run"),
        ("show", "run", "--scene", "0", "--trial", "best", "--out", "sheet.png"),
    ]


# The commands of each picture, in a folder of its own; `make demo` makes the first.
PICTURES: dict[str, list[tuple[str, ...]]] = {
    "labels.png": [
        ("submit", "heuristic", "--n", "600", *NEAR, "--out", "run"),
        ("show", "run", "--scene", "9", "--out", "labels.png"),
    ],
    "outcomes.png": [
        ("submit", "plan", "--n", "1875", *GRID, "--out", "run"),
        ("show", "run", "--scene", "2", "--out", "outcomes.png"),
    ],
    "trial.png": [
        ("submit", "sim", "--n", "120", "--config", "run.toml", *NEAR, "--out", "run"),
        ("show", "run", "--scene", "1", "--trial", "best", "--out", "trial.png"),
    ],
    "places.png": [
        ("submit", "plan", "--n", "30", "--config", "run.toml", *NEAR, "--out", "run"),
        ("show", "run", "--scene", "0", "--out", "places.png"),
    ],
    "predict.png": [("predict", "--demo", "--out", "predict.png", "--html", "page.html")],
    **{f"{robot}.webp": _trial(robot) for robot in ROBOTS},
}


# What a picture's commands find in their folder as run.toml; the others show open tops.
CONFIGS = {
    "places.png": "[scene]\nn_clutter = 4\ndecisive = 1.0\n[scene.places]\ninside = 1\n"
    "[candidates]\nper_scene = 30\narm_reach_m = {low = 0.9, high = 1.0}\n"
}


def make(name: str, out: Path) -> None:
    """Make one picture and write it to `out`. RuntimeError where a command fails."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        Path("run.toml").write_text(CONFIGS.get(name, "[scene]\nplaces = {}\n"))
        try:
            for words in PICTURES[name]:
                if cli.run([*words, *(("--workers", "0") if words[0] == "submit" else ())]):
                    raise RuntimeError(f"datagen {' '.join(words)}: failed")
            if name.endswith(".webp"):
                _shrink(Path("sheet.png"), Path(name))
            out.write_bytes(Path(name).read_bytes())
        finally:
            os.chdir(before)


def _shrink(sheet: Path, out: Path) -> None:
    with Image.open(sheet) as picture:
        size = SMALL_PX, round(picture.height * SMALL_PX / picture.width)
        small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    small.save(out, quality=QUALITY, method=6)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else IMAGES).resolve()
    for picture in sys.argv[2:] or PICTURES:
        make(picture, target / picture)
