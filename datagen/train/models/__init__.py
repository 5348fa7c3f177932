"""Models behind one interface: `score(clouds, candidates, robots) -> logits (N, 2)`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from datagen.train.models.model import Model
from datagen.train.models.n2m import N2mModel
from datagen.train.models.paper import PaperModel
from datagen.train.models.shared import SharedModel
from datagen.workers.registry import entry

MODELS: dict[str, Callable[[Mapping[str, Any]], Model]] = {
    "paper": PaperModel,
    "shared": SharedModel,
    "n2m": N2mModel,
}


def build_model(name: str, config: Mapping[str, Any]) -> Model:
    """Build the model of that name with new parameters from torch's global generator.

    Fields of `config` have defaults. The name may be `module:attribute` outside the package. InputError names
    an unknown model or field, or a value out of range.
    """
    build = MODELS[name] if name in MODELS else entry(dict.fromkeys(MODELS, ""), name, "--model")
    return build(config)


__all__ = ["MODELS", "Model", "build_model"]
