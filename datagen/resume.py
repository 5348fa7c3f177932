"""`datagen resume`: make what is missing of a run, or of merged runs."""

from __future__ import annotations

import sys
from typing import Annotated

from cyclopts import Parameter

from datagen.jobs.detach import detach_job
from datagen.jobs.going_on import Sources, go_on, open_work
from datagen.jobs.options import (
    DEFAULT_SHARE,
    Address,
    Detach,
    HousesAgain,
    JsonLines,
    MaxQuarantined,
    ObjectsAgain,
    Placing,
    Quarantined,
    ScenesFromAgain,
    Workers,
    absolute_place,
    resumable,
    words_of,
)
from schemas.merged import open_runs
from schemas.quarantine import lift_quarantine
from schemas.storage import open_storage


def resume(
    run: Annotated[str, Parameter(help="The run's folder or s3:// address; also of merged runs.")],
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
    placing, given = (
        Placing(workers, address, json, max_quarantined, detach),
        Sources(houses, objects, scenes_from),
    )
    placing.refuse_bad()
    words = ["resume", absolute_place(run), *words_of({"--quarantined": quarantined}), *given.words()]
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
            sys.stderr.write(f"{lifted} shards are taken out of quarantine\n")
    return go_on(place, run, works, placing, given)
