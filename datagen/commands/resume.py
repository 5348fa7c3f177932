"""`datagen resume`: make the missing shards of a run, or of merged runs."""

from __future__ import annotations

import sys
from typing import Annotated

from cyclopts import Parameter

from datagen.console.command_lines import words_of
from datagen.console.options import RunPlace
from datagen.console.printing import counted
from datagen.jobs.detach import detach_job
from datagen.jobs.options import HERE, JobOptions, absolute_place, opening
from datagen.jobs.start_job import open_job_run, source_words, start_job
from datagen.regeneration.sources import AS_FOUND, Sources
from datagen.schemas.merged_runs import open_runs
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
    job_options: JobOptions = HERE,
) -> int:
    """Make the missing shards of a run and seal it. Committed shards are not made again.

    The parts of merged runs are resumed one after the other.

    For example: datagen resume runs/first
    """
    job_options.refuse_bad()
    words = ["resume", absolute_place(run), *words_of({"--quarantined": quarantined}), *source_words(given)]
    words += job_options.words()
    if job_options.detach and job_options.address != "local":
        return detach_job(words, run, job_options)
    with opening(words, job_options) as began_s:
        place = open_storage(run, create=False)
        runs = open_runs(place)
        job_runs = [open_job_run(part, given, job_options.address) for part in runs]
        if job_options.detach:
            return detach_job(words, run, job_options)
        if quarantined:
            lifted = sum(len(lift_quarantine(part)) for part in runs)
            sys.stderr.write(f"out of quarantine: {counted(lifted, 'shard')}\n")
    return start_job(place, run, job_runs, job_options, began_s, given)
