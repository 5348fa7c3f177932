"""`datagen resume`: make the missing shards of a run, or of merged runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Unpack

from datagen.console.command_lines import prints, words_of
from datagen.console.options import AS_FOUND, RUN, Sources
from datagen.console.printing import counted
from datagen.jobs.dry_run import PlannedRun
from datagen.jobs.job import JobRun
from datagen.jobs.job_report import JobResult, print_job
from datagen.jobs.options import JobKeywords, JobOptions, absolute_path
from datagen.jobs.start_job import continue_job, planned_run, source_words
from datagen.schemas.quarantine import lift_quarantine


@prints(print_job)
def resume(
    run: Annotated[str | Path, RUN],
    /,
    *,
    quarantined: bool = False,
    given: Sources = AS_FOUND,
    **job: Unpack[JobKeywords],
) -> JobResult:
    """Make the missing shards of a run and seal it. Committed shards are not made again.

    The parts of merged runs are resumed one after the other.

    For example: datagen resume runs/first

    Args:
        run: Folder or s3:// address of a run or of merged runs.
        quarantined: Try quarantined shards again; their records are kept.
        given: New locations of houses, objects and the run with the scenes, where they have moved.
        job: As for `submit`: `workers`, `address`, `max_quarantined`, `detach`, `dry_run`, `budget`,
            `prices`, `json` and `quiet`.

    Returns:
        The result of the job.

    Raises:
        InputError: The run or a source cannot be used.
        KeyboardInterrupt: The job was stopped; the run can be resumed.

    Example:
        >>> result = datagen.resume(run, workers=0, quiet=True)
        >>> result.complete, result.labels, result.remaining
        (True, 0, 0)
    """
    run, job_options = str(run), JobOptions(**job)
    job_options.refuse_bad()
    words = ["resume", absolute_path(run), *words_of({"--quarantined": quarantined}), *source_words(given)]
    words += job_options.words()

    def lift(job_runs: Sequence[JobRun]) -> None:
        if quarantined and not job_options.detach:
            lifted = sum(len(lift_quarantine(job_run.run)) for job_run in job_runs)
            if not job_options.quiet:
                sys.stderr.write(f"out of quarantine: {counted(lifted, 'shard')}\n")

    def planned(job_runs: Sequence[JobRun]) -> list[PlannedRun]:
        return [planned_run(job_run, job_run.run.n, quarantined) for job_run in job_runs]

    return continue_job(words, run, given, job_options, lift, planned)
