"""Command lines of `datagen predict`, and copies of a frame that are changed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

HEIGHT_M = 0.8197  # the scene's camera above the floor


def arguments(folder: Path, *more: str, drop: tuple[str, ...] = ()) -> list[str]:
    """A whole command line, with options left out, replaced or added."""
    chosen = {
        "--frame": str(folder / "frame"),
        "--camera-height": str(HEIGHT_M),
        "--base-height": "0.7",
        "--reach": "0.9",
    }
    chosen |= dict(zip(more[::2], more[1::2], strict=True))
    pairs = [text for name, value in chosen.items() if name not in drop for text in (name, value)]
    return ["predict", str(folder / "model.ckpt"), *pairs]


def frame_with(source: Path, folder: Path, **files: Path | np.ndarray | None) -> str:
    """A copy of a frame in which files are replaced, by name before the dot, or left out."""
    frame = folder / "changed"
    frame.mkdir()
    for path in source.iterdir():
        if path.stem not in files:
            (frame / path.name).symlink_to(path)
    endings = {"intrinsics": ".json", "pose": ".json"}
    for name, content in files.items():
        if isinstance(content, np.ndarray):
            Image.fromarray(content).save(frame / f"{name}.png")
        elif content is not None:
            (frame / f"{name}{endings.get(name, '.png')}").symlink_to(content)
    return str(frame)


def pictures(made: Path) -> tuple[np.ndarray, np.ndarray]:
    """Depth and mask of the frame, to be changed."""
    depth, mask = (np.array(Image.open(made / "frame" / f"{name}.png")) for name in ("depth", "mask"))
    return depth, mask > 0
