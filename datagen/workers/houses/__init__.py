"""Sources of houses, by name. Adding one is one file with an `open_...` function and one line here."""

from __future__ import annotations

from datagen.workers.houses.house import HouseSource
from datagen.workers.houses.split import ids_of_split, split_of
from datagen.workers.registry import open_source

# Each function opens the source that the text after a reference's colon describes.
HOUSE_SOURCES: dict[str, str] = {
    "builtin": "datagen.workers.procedural_houses.builtin:open_builtin",
    "procthor": "datagen.workers.houses.procthor:open_procthor",
    "ai2thor": "datagen.workers.houses.ai2thor:open_ai2thor",
}


def open_houses(ref: str) -> HouseSource:
    """The source that a reference names: `builtin`, `procthor:DIR` or `ai2thor:DIR`."""
    return open_source(HOUSE_SOURCES, ref, "--houses")


__all__ = ["HOUSE_SOURCES", "HouseSource", "ids_of_split", "open_houses", "split_of"]
