"""The model that ships with the package: its checkpoint, its card, and a sample frame."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from datagen.schemas.errors import InputError

RELEASED = "released"
FOLDER = Path(str(files("datagen.released")))
CHECKPOINT, PROGRAM, FRAME = "model.safetensors", "program.safetensors", "frame"
CLICKS = "clicks.safetensors"  # weights of the network that segments what is clicked
# The facts, how the model was made, and the page of both.
CARD, RECIPE, CARD_PAGE = "card.json", "recipe.md", "MODEL_CARD.md"
MAP = "map.yaml"  # of the house, in the sample frame's folder
# The robot of `datagen predict --demo`.
DEMO_BASE_HEIGHT_M, DEMO_REACH_M = 0.7, 0.9


def released_checkpoint() -> Path:
    """The checkpoint of the released model."""
    return _shipped_path(CHECKPOINT)


def released_program() -> Path:
    """The released model as NumPy's operations (`datagen.train.program_scorer`)."""
    return _shipped_path(PROGRAM)


def released_click_network() -> Path:
    """Weights of `datagen.train.prediction.click_network`."""
    return _shipped_path(CLICKS)


def checkpoint_file(name: str) -> str | None:
    """The file of a checkpoint, or None; `released` is the released model unless there is such a file."""
    if Path(name).is_file():
        return name
    return str(released_checkpoint()) if name == RELEASED else None


def sample_frame() -> Path:
    """The folder of the sample frame, as `datagen predict --frame` reads it."""
    return _shipped_path(FRAME)


def _shipped_path(name: str) -> Path:
    if not (path := FOLDER / name).exists():
        raise InputError(path, "", "does not exist", "Install the package again")
    return path
