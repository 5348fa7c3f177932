"""`datagen resume`: make the missing shards of a run, or of merged runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from typing_extensions import Unpack

from datagen.console.command_lines import words_of
from datagen.console.options import RunPlace
from datagen.console.printing import counted
from datagen.jobs.job import JobRun
from datagen.jobs.job_report import reported
from datagen.jobs.job_result import JobResult
from datagen.jobs.options import HERE, JobKeywords, JobOptions, absolute_place
from datagen.jobs.start_job import continue_job, source_words
from datagen.regeneration.sources import AS_FOUND, Sources
from datagen.schemas.quarantine import lift_quarantine


def verb(
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
    return reported(lambda: resume(run, quarantined=quarantined, given=given, job_options=job_options))


def resume(
    run: str | Path,
    *,
    quarantined: bool = False,
    given: Sources = AS_FOUND,
    job_options: JobOptions | None = None,
    **where: Unpack[JobKeywords],
) -> JobResult:
    """Make every missing shard of a run or of merged runs, seal it, and return what was done.

    Args:
        run: The run's folder or s3:// address.
        quarantined: Try the shards in quarantine again.
        given: Where houses, objects and the run of its scenes lie now, if they have moved.
        job_options: What the command line gives instead of `where`.
        where: As of `submit`: `workers`, `address`, `max_quarantined`, `detach` and `quiet`.

    Raises:
        InputError: The run or a source cannot be used.
        KeyboardInterrupt: The job was stopped; the run can be resumed.

    Example:
        >>> result = datagen.resume(run, workers=0, quiet=True)
        >>> result.complete, result.labels, result.remaining
        (True, 0, 0)
    """
    run, job_options = str(run), job_options or JobOptions(**where)
    job_options.refuse_bad()
    words = ["resume", absolute_place(run), *words_of({"--quarantined": quarantined}), *source_words(given)]
    words += job_options.words()

    def lift(job_runs: Sequence[JobRun]) -> None:
        if quarantined and not job_options.detach:
            lifted = sum(len(lift_quarantine(job_run.run)) for job_run in job_runs)
            if not job_options.quiet:
                sys.stderr.write(f"out of quarantine: {counted(lifted, 'shard')}\n")

    return continue_job(words, run, given, job_options, lift)
