"""Models behind one interface: `score(clouds, candidates, robots) -> logits (N, 2)`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from datagen.schemas.errors import InputError, choices
from datagen.train.models.model import Model, fast
from datagen.train.models.n2m import N2mModel
from datagen.train.models.paper import PaperModel
from datagen.train.models.shared import SharedModel

MODELS: dict[str, Callable[[Mapping[str, Any]], Model]] = {
    "paper": PaperModel,
    "shared": SharedModel,
    "n2m": N2mModel,
}


def build_model(name: str, config: Mapping[str, Any]) -> Model:
    """Build the model of that name with new parameters from torch's global generator.

    Fields of `config` have defaults. InputError names an unknown model or field, or a value out of range.
    """
    if name not in MODELS:
        raise InputError("model", name, "is unknown", choices(MODELS, name))
    return MODELS[name](config)


__all__ = ["MODELS", "Model", "build_model", "fast"]
