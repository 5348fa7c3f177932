"""`datagen resume`: make what is missing of a run, or of merged runs."""

from __future__ import annotations

import sys

from datagen.console.options import RunPlace
from datagen.console.printing import counted
from datagen.jobs.detach import detach_job
from datagen.jobs.going_on import go_on, open_work, source_words
from datagen.jobs.options import (
    DEFAULT_SHARE,
    Address,
    Detach,
    JsonLines,
    MaxQuarantined,
    Placing,
    Quarantined,
    Workers,
    absolute_place,
    resumable,
    words_of,
)
from datagen.remaking.sources import HousesAgain, ObjectsAgain, ScenesFromAgain, Sources
from schemas.merged import open_runs
from schemas.quarantine import lift_quarantine
from schemas.storage import open_storage


def resume(
    run: RunPlace,
    *,
    quarantined: Quarantined = False,
    houses: HousesAgain = None,
    objects: ObjectsAgain = None,
    scenes_from: ScenesFromAgain = None,
    workers: Workers = None,
    address: Address = "local",
    max_quarantined: MaxQuarantined = DEFAULT_SHARE,
    detach: Detach = False,
    json: JsonLines = False,
) -> int:
    """Make every missing shard of a run, and seal it: of what was begun, nothing is made twice.

    Of merged runs every part is resumed, one after the other.
    """
    placing = Placing(workers, address, json, max_quarantined, detach)
    given = Sources(houses, objects, scenes_from)
    placing.refuse_bad()
    words = ["resume", absolute_place(run), *words_of({"--quarantined": quarantined}), *source_words(given)]
    words += placing.words()
    if detach and address != "local":
        return detach_job(words, run, placing)
    with resumable([*words, *words_of({"--address": None if address == "local" else address})]):
        place = open_storage(run, create=False)
        runs = open_runs(place)
        works = [open_work(part, given, address) for part in runs]
        if detach:
            return detach_job(words, run, placing)
        if quarantined:
            lifted = sum(len(lift_quarantine(part)) for part in runs)
            sys.stderr.write(f"out of quarantine: {counted(lifted, 'shard')}\n")
    return go_on(place, run, works, placing, given)
