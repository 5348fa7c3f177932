"""Labels of base poses. LABEL_SOURCES is the registry; each source lives in one file."""

from __future__ import annotations

from importlib import import_module

from schemas.errors import InputError, choices
from workers.labels.source import LabelSource

# Name -> module and the LabelSource in it, imported when it is asked for.
LABEL_SOURCES: dict[str, str] = {
    "heuristic": "workers.labels.distance_visibility:HEURISTIC",
}


def load_label_source(name: str) -> LabelSource:
    """The label source of that name. Raises InputError where there is none."""
    if name not in LABEL_SOURCES:
        raise InputError("label source", name or "''", "no such label source", choices(LABEL_SOURCES))
    module, attribute = LABEL_SOURCES[name].split(":")
    source: LabelSource = getattr(import_module(module), attribute)
    return source
