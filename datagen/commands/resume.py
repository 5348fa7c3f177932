"""`datagen resume`: make what is missing of a run, or of merged runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

from cyclopts import Parameter

from datagen.console.command_lines import words_of
from datagen.console.options import RunPlace
from datagen.console.printing import counted
from datagen.jobs.going_on import continue_job, source_words
from datagen.jobs.job import Work
from datagen.jobs.options import HERE, Placing, absolute_place
from datagen.remaking.sources import AS_FOUND, Sources
from datagen.schemas.quarantine import lift_quarantine


def resume(
    run: RunPlace,
    *,
    quarantined: Annotated[
        bool,
        Parameter(negative=(), help="Try the shards in quarantine again; their records stay as history."),
    ] = False,
    given: Sources = AS_FOUND,
    placing: Placing = HERE,
) -> int:
    """Make every missing shard of a run, and seal it: of what was begun, nothing is made twice.

    Of merged runs every part is resumed, one after the other.
    """
    placing.refuse_bad()
    words = ["resume", absolute_place(run), *words_of({"--quarantined": quarantined}), *source_words(given)]
    words += placing.words()

    def lift(works: Sequence[Work]) -> None:
        if quarantined and not placing.detach:
            lifted = sum(len(lift_quarantine(work.run)) for work in works)
            sys.stderr.write(f"out of quarantine: {counted(lifted, 'shard')}\n")

    return continue_job(words, run, given, placing, lift)
