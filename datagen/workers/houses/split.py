"""House-disjoint splits: a house is in train, val or test by its own id alone."""

from __future__ import annotations

import hashlib
from typing import Literal

from datagen.workers.houses.house import HouseSource

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
