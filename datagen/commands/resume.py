"""`datagen resume`: make the missing shards of a run, or of merged runs."""

from __future__ import annotations

import sys
from typing import Annotated

from cyclopts import Parameter

from datagen.console.command_lines import words_of
from datagen.console.options import RunPlace
from datagen.console.printing import counted
from datagen.jobs.detach import detach_job
from datagen.jobs.going_on import go_on, open_work, source_words
from datagen.jobs.options import HERE, Placing, absolute_place, opening
from datagen.remaking.sources import AS_FOUND, Sources
from datagen.schemas.merged import open_runs
from datagen.schemas.quarantine import lift_quarantine
from datagen.schemas.storage import open_storage


def resume(
    run: RunPlace,
    /,
    *,
    quarantined: Annotated[
        bool, Parameter(negative=(), help="Try quarantined shards again; their records are kept.")
    ] = False,
    given: Sources = AS_FOUND,
    placing: Placing = HERE,
) -> int:
    """Make the missing shards of a run and seal it. Committed shards are not made again.

    The parts of merged runs are resumed one after the other.

    For example: datagen resume runs/first
    """
    placing.refuse_bad()
    words = ["resume", absolute_place(run), *words_of({"--quarantined": quarantined}), *source_words(given)]
    words += placing.words()
    if placing.detach and placing.address != "local":
        return detach_job(words, run, placing)
    with opening(words, placing) as began_s:
        place = open_storage(run, create=False)
        runs = open_runs(place)
        works = [open_work(part, given, placing.address) for part in runs]
        if placing.detach:
            return detach_job(words, run, placing)
        if quarantined:
            lifted = sum(len(lift_quarantine(part)) for part in runs)
            sys.stderr.write(f"out of quarantine: {counted(lifted, 'shard')}\n")
    return go_on(place, run, works, placing, began_s, given)
