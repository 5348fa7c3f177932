"""Sources of houses, by name. Adding one is one file with an `open_...` function and one line here."""

from __future__ import annotations

from collections.abc import Callable

from schemas.errors import InputError, choices
from workers.houses.house import HouseSource
from workers.houses.split import ids_of_split, split_of


def _builtin(text: str) -> HouseSource:
    from workers.houses.builtin import open_builtin

    return open_builtin(text)


def _procthor(text: str) -> HouseSource:
    from workers.houses.procthor import open_procthor

    return open_procthor(text)


def _ai2thor(text: str) -> HouseSource:
    from workers.houses.ai2thor import open_ai2thor

    return open_ai2thor(text)


# Each opens the source that the text after the colon of a reference describes.
HOUSE_SOURCES: dict[str, Callable[[str], HouseSource]] = {
    "builtin": _builtin,
    "procthor": _procthor,
    "ai2thor": _ai2thor,
}


def open_houses(ref: str) -> HouseSource:
    """The source that a reference names: `builtin`, `procthor:DIR` or `ai2thor:DIR`."""
    kind, _, text = ref.partition(":")
    if kind not in HOUSE_SOURCES:
        raise InputError("--houses", kind, "no such kind of houses", choices(HOUSE_SOURCES) + ".")
    return HOUSE_SOURCES[kind](text)


__all__ = ["HOUSE_SOURCES", "HouseSource", "ids_of_split", "open_houses", "split_of"]
