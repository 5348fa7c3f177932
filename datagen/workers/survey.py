"""Houses and objects that a source cannot use or leaves out, counted when a run is made from it."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.content_cache import CacheFolder
from datagen.workers.houses.house import HouseSource
from datagen.workers.objects.model import ObjectSource
from datagen.workers.world import World

# Raise it when the same house may be judged differently.
_VERSION = 2
_CACHE = CacheFolder("surveys", most_files=64)


@dataclass(frozen=True)
class Survey:
    """`unusable` maps houses or objects to reasons, `findings` counts things in the others by cause."""

    read: int
    unusable: Mapping[str, str]
    findings: Mapping[str, int]

    @property
    def causes(self) -> dict[str, int]:
        """Unusable houses or objects by cause, most frequent first: what a reason has before its colon."""
        return dict(Counter(map(_cause, self.unusable.values())).most_common())

    def lines(self, source: str, *, with_reasons: bool) -> list[str]:
        """What to print of a source: a line, and perhaps one for each unusable house or object."""
        reasons = self.unusable.items() if with_reasons else ()
        return [f"{source}: {self}", *(f"  {name}: {reason}" for name, reason in reasons)]

    def __str__(self) -> str:
        text = f"{self.read:,} read"
        if self.unusable:
            text += f", {len(self.unusable):,} unusable ({_listed(self.causes)})"
        return f"{text}; in the others {_listed(self.findings)}" if self.findings else text


def survey_sources(
    houses: HouseSource, objects: ObjectSource, seen: Callable[[int, int], object]
) -> dict[str, Survey]:
    """Surveys of "houses" and "objects", without sources that have no files. `seen(done, of)` is called."""
    found = {"houses": _of_houses(houses, seen)}
    if objects.kind != "builtin":
        notes: Mapping[str, Mapping[str, str]] = getattr(objects, "notes", {})
        counted = Counter(cause for each in notes.values() for cause in each)
        read = len(objects.names()) + len(objects.excluded)
        found["objects"] = Survey(read, dict(objects.excluded), dict(counted.most_common()))
    return {what: survey for what, survey in found.items() if survey is not None}


def stored_notes(world: World, surveys: Mapping[str, Survey]) -> dict[str, str]:
    """Numbers of houses and objects, and what their folders state of themselves, for a manifest.

    The number is "2 of 6" where four of six houses are unusable.
    """
    house_ids, object_names = world.house_ids, world.object_names
    bad = surveys["houses"].unusable if "houses" in surveys else {}
    usable = sum(house_id not in bad for house_id in house_ids)
    of = f" of {len(house_ids)}" if usable < len(house_ids) else ""
    counts = {"n_houses": f"{usable}{of}", "n_objects": str(len(object_names))}
    counts |= {f"{what}_read": str(survey) for what, survey in surveys.items()}
    for what, source in (("houses", world.houses), ("objects", world.objects)):
        stated: Mapping[str, str] = getattr(source, "statement", {})
        counts |= {f"{what}_{key}": text for key, text in stated.items()}
    return counts


def _of_houses(source: HouseSource, seen: Callable[[int, int], object]) -> Survey | None:
    """The survey of all houses, cached by content: the first takes 5 ms a house.

    `examine(house_id)`, which returns a house's findings or raises InputError, is optional in sources. So is
    `changed_ns`, of those whose digest does not cover the content of their houses.
    """
    examine: Callable[[str], Mapping[str, int]] | None = getattr(source, "examine", None)
    if examine is None:
        return None
    key = f"{source.kind}-{source.digest}-v{_VERSION}{getattr(source, 'changed_ns', '')}"
    stored = _CACHE.load(key)
    if stored is not None:
        return Survey(**json.loads(str(stored["survey"])))
    ids, unusable, findings = source.house_ids(), dict[str, str](), Counter[str]()
    for done, house_id in enumerate(ids):
        seen(done, len(ids))
        try:
            findings.update(examine(house_id))
        except InputError as error:
            unusable[house_id] = f"{error.problem} ({error.place}: {error.field})"
    survey = Survey(len(ids), unusable, dict(findings.most_common()))
    _CACHE.store(key, {"survey": np.array(json.dumps(asdict(survey)))})
    return survey


def _cause(reason: str) -> str:
    return re.sub(r"'[^']*'|-?\d[\d.,]*", "..", reason.partition(":")[0].partition(" (")[0])[:80]


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{cause} {count:,}" for cause, count in counts.items())
