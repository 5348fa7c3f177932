"""Sources of houses, by name. Adding one is one file with an `open_...` function and one line here."""

from __future__ import annotations

from importlib import import_module

from schemas.errors import InputError, choices
from workers.houses.house import HouseSource
from workers.houses.split import ids_of_split, split_of

# Name -> module and function that opens the source which the text after a reference's colon
# describes. A kind's module is imported when it is asked for.
HOUSE_SOURCES: dict[str, str] = {
    "builtin": "workers.houses.builtin:open_builtin",
    "procthor": "workers.houses.procthor:open_procthor",
    "ai2thor": "workers.houses.ai2thor:open_ai2thor",
}


def open_houses(ref: str) -> HouseSource:
    """The source that a reference names: `builtin`, `procthor:DIR` or `ai2thor:DIR`."""
    kind, _, text = ref.partition(":")
    if kind not in HOUSE_SOURCES:
        raise InputError("--houses", kind, "no such kind of houses", choices(HOUSE_SOURCES) + ".")
    module, function = HOUSE_SOURCES[kind].split(":")
    source: HouseSource = getattr(import_module(module), function)(text)
    return source


__all__ = ["HOUSE_SOURCES", "HouseSource", "ids_of_split", "open_houses", "split_of"]
