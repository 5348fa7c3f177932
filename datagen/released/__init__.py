"""The model that ships with the package: its checkpoint, its card, and a sample frame."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError

RELEASED = "released"
FOLDER = Path(str(files("datagen.released")))
CHECKPOINT, RESULTS, FRAME = "model.safetensors", "results.json", "frame"
# The facts, how the model was made, and the page of both.
CARD, RECIPE, CARD_PAGE = "card.json", "recipe.md", "MODEL_CARD.md"
# What `datagen predict --demo` asks on the sample frame: a pixel on the blue cup, and a robot.
DEMO_CLICK = (390, 256)
DEMO_BASE_HEIGHT_M, DEMO_REACH_M = 0.7, 0.9


def released_checkpoint() -> Path:
    """The checkpoint of the released model."""
    return _there(CHECKPOINT)


def sample_frame() -> Path:
    """The folder of the sample frame, as `datagen predict --frame` reads it."""
    return _there(FRAME)


def released_card() -> dict[str, Any]:
    """The facts of the model card."""
    return json.loads(_there(CARD).read_bytes())


def _there(name: str) -> Path:
    if not (path := FOLDER / name).exists():
        raise InputError(path, "", "does not exist", "Install the package again")
    return path
