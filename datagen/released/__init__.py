"""The model that ships with the package: its checkpoint, its card, and a sample frame."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError

RELEASED = "released"
FOLDER = Path(str(files("datagen.released")))
CHECKPOINT, CARD, RESULTS, FRAME = "model.safetensors", "card.json", "benchmark.json", "frame"


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
