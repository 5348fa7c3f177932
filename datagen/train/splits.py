"""Split training data into training and validation sides without common houses."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError
from datagen.train.dataset import SampleStream

# These salts differ from that of a run's own split (workers/houses/split.py): the tenth that is held out
# here is also a tenth of that split's training houses.
_SALT = b"held-out-houses-1:"
_SHARE_SALT = b"share-of-houses-1:"


@dataclass(frozen=True)
class HouseSide:
    """The houses of one side, by id only: adding or removing houses moves no other house."""

    held_out: bool

    def __call__(self, house_id: str) -> bool:
        return (_number(_SALT, house_id) % 10 == 0) == self.held_out


@dataclass(frozen=True)
class HouseShare:
    """A share of the houses (of one side), by id alone: a larger share has all houses of a smaller one."""

    share: float
    side: HouseSide | None = None

    def __call__(self, house_id: str) -> bool:
        chosen = _number(_SHARE_SALT, house_id) < self.share * 2**64
        return chosen and (self.side is None or self.side(house_id))


def _number(salt: bytes, house_id: str) -> int:
    """A number of the house, uniform over 0 .. 2**64 - 1."""
    return int.from_bytes(hashlib.sha256(salt + house_id.encode()).digest()[:8], "big")


def split_by_house(
    paths: Sequence[str | Path], share: float = 1.0, **options: Any
) -> tuple[SampleStream, SampleStream]:
    """(training, validation) streams of runs: nine tenths of the houses, and the tenth that is held out.

    `share` is the part of the nine tenths to train on. `options` are those of SampleStream for training;
    validation is not shuffled. InputError where a side has no house.
    """
    plain: dict[str, Any] = {**options, "shuffle": False}
    try:
        validation = SampleStream(paths, **plain, houses=HouseSide(held_out=True))
        train = SampleStream(paths, **options, houses=HouseShare(share, HouseSide(held_out=False)))
    except InputError as error:
        if error.field != "house_id":
            raise
        fix = "Name a run of other houses with --val, or train on runs of more houses"
        problem = "has too few houses to hold out a tenth for validation"
        raise InputError(error.place, "house_id", problem, fix) from error
    refuse_shared_houses(train, validation)
    return train, validation


def refuse_shared_houses(train: SampleStream, other: SampleStream) -> None:
    """Raise InputError where both sides have scenes of a house, by id or by content."""
    ours, theirs = train.house_digests(), other.house_digests()
    shared = {house: house for house in train.house_ids() & other.house_ids()}
    shared |= {ours[digest]: theirs[digest] for digest in ours.keys() & theirs.keys() if digest}
    if not shared:
        return
    house, twin = min(shared.items())
    also = "" if house == twin else f" (there as {twin!r}, with equal content)"
    places = ", ".join(dict.fromkeys(part.part.place for part in other.parts))
    problem = f"house {house!r} is also in the training data{also}, one of {len(shared)} such houses"
    raise InputError(places, "house_id", problem, "Use runs of other houses, as `submit --split` makes them")


def refuse_one_class(stream: SampleStream) -> None:
    """Raise InputError where all labels are equal."""
    counts = stream.class_counts()
    if all(counts):
        return
    places = ", ".join(dict.fromkeys(part.part.place for part in stream.parts))
    problem = f"all {sum(counts)} labels are {0 if counts[0] else 1}"
    fix = "Name more runs, or a run with another choice of candidates (`submit --candidates`)"
    raise InputError(places, "label", problem, fix)
