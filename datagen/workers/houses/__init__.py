"""Sources of houses, by name. Adding one is one file with an `open_...` function and one line here."""

from __future__ import annotations

import hashlib
from typing import Literal

from datagen.workers.houses.house import HouseSource
from datagen.workers.registry import open_source

# Each function opens the source that the text after a reference's colon describes.
HOUSE_SOURCES: dict[str, str] = {
    "builtin": "datagen.workers.procedural_houses.builtin:open_builtin",
    "procthor": "datagen.workers.houses.procthor:open_procthor",
    "ai2thor": "datagen.workers.houses.ai2thor:open_ai2thor",
    "habitat": "datagen.workers.houses.habitat:open_habitat",
    "map": "datagen.workers.houses.map_rooms:open_map",
}


def open_houses(ref: str) -> HouseSource:
    """The source that a reference names: `builtin`, or procthor, ai2thor, habitat or map with `:PATH`."""
    return open_source(HOUSE_SOURCES, ref, "--houses")


__all__ = ["HOUSE_SOURCES", "HouseSource", "ids_of_split", "open_houses", "split_of"]


SplitName = Literal["train", "val", "test"]

# Part of the data: another salt would move houses between the splits of finished runs.
_SALT = b"house-split-1:"


def split_of(house_id: str) -> SplitName:
    """80 / 10 / 10 by hash of the id: adding or removing houses moves no other house."""
    digest = hashlib.sha256(_SALT + house_id.encode()).digest()
    tenth = int.from_bytes(digest[:8], "big") % 10
    return "val" if tenth == 8 else "test" if tenth == 9 else "train"


def ids_of_split(source: HouseSource, split: Literal["train", "val", "test", "all"]) -> list[str]:
    """Ids of the source's houses in the split, in the source's order."""
    ids = source.house_ids()
    return ids if split == "all" else [i for i in ids if split_of(i) == split]
