"""`datagen resume`: make the missing shards of a run, or of merged runs; with --n, extend it first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from datagen.configuration.stored_scenes import StoredScenes, refuse_too_few
from datagen.console.command_lines import (
    absolute_path,
    beginning_s,
    given_options,
    options_of,
    prints,
    resumable,
    words_of,
)
from datagen.console.options import LABELLED, RUN, Sources, Whole, option
from datagen.console.printing import counted
from datagen.jobs.detach import detach_job
from datagen.jobs.job import Job, JobOptions, JobRun
from datagen.jobs.job_report import JobResult, print_job
from datagen.jobs.start_job import open_job_run, with_absolute_paths, words_to_resume
from datagen.schemas.errors import InputError
from datagen.schemas.quarantine import lift_quarantine
from datagen.schemas.run import Run, open_runs, refuse_odd_n
from datagen.schemas.storage import open_storage


@dataclass(frozen=True, kw_only=True)
class ResumeOptions(JobOptions, Sources):
    """Options of `resume`."""

    run: Annotated[str | Path, RUN] = field(kw_only=False)
    n: Annotated[
        Whole | None,
        option("Labels wanted in total, to extend the run; not fewer than now. [default: as now]", LABELLED),
    ] = None
    quarantined: Annotated[
        bool, option("Try quarantined shards again; their records are kept.", LABELLED)
    ] = False


@prints(print_job)
@options_of(ResumeOptions)
def resume(options: ResumeOptions) -> JobResult:
    """Make the missing shards of a run and seal it. Committed shards are not made again.

    The parts of merged runs are resumed one after the other. With --n, new labels are divided evenly among
    the parts, in whole shards.

    For example: datagen resume runs/first --n 360,000

    Returns:
        The result of the job.

    Raises:
        InputError: The run or a source cannot be used.
        KeyboardInterrupt: The job was stopped; the run can be resumed.

    Examples:
        >>> result = datagen.resume(run, workers=0, quiet=True)
        >>> result.complete, result.labels, result.remaining
        (True, 0, 0)
    """
    began_s, path = beginning_s(), str(options.run)
    options.refuse_bad()
    if options.n is not None:
        refuse_odd_n(options.n)
    options = with_absolute_paths(options)
    words = ["resume", absolute_path(path), *words_of(given_options(options))]
    again = words_to_resume(path, options, options)
    with resumable(again):
        with options.display() as shown:
            shown.phase("opening houses and objects")
            storage = open_storage(path, create=False)
            job_runs = [open_job_run(each, options) for each in open_runs(storage)]
        if options.n is not None:
            _extend(job_runs, options.n, path)
        if options.quarantined:
            lifted = sum(len(lift_quarantine(job_run.run)) for job_run in job_runs)
            with options.display() as shown:
                shards = counted(lifted, "shard")
                shown.say("out_of_quarantine", {"shards": lifted}, f"out of quarantine: {shards}")
    if options.detach:
        return detach_job(again, path)
    return Job(storage, path, job_runs, options, began_s, words, again).run()


def _extend(job_runs: Sequence[JobRun], n: int, path: str) -> None:
    """Raise the number of labels to n in total. InputError where it is smaller now, or scenes are lacking."""
    # Parts of one specification, in shards of other sizes, share its number of labels.
    growing = list({job_run.run.manifest.spec_hash: job_run for job_run in reversed(job_runs)}.values())[::-1]
    have = [job_run.run.n for job_run in growing]
    planned = sum(have)
    if n < planned:
        problem = f"{path} already has {planned:,} planned, and a run never shrinks"
        raise InputError("--n", str(n), problem, f"Give {planned} or more")
    sizes = [job_run.run.layout.samples_per_shard for job_run in growing]
    wanted = {
        job_run.run.manifest.spec_hash: more
        for job_run, more in zip(growing, shares(have, sizes, n), strict=True)
    }
    for job_run in job_runs:
        more = wanted[job_run.run.manifest.spec_hash]
        if job_run.scenes_from:
            stored = StoredScenes(Run.open(job_run.scenes_from), job_run.houses, job_run.objects)
            refuse_too_few(stored, job_run.run.layout, more)
    for job_run in job_runs:
        job_run.run.grow(wanted[job_run.run.manifest.spec_hash])


def shares(have: Sequence[int], per_shard: Sequence[int], n: int) -> list[int]:
    """Grow `have` by whole shards until they sum to n: evenly, and the remainder to the last.

    `per_shard` holds the labels of one shard of each run. Each new shard goes to the run with the fewest
    new labels so far, the first of equals. A store is cut only at its end, so only the last run may
    need a part of a shard.
    """
    # The common part is added at once: n may be a million shards away.
    missing = n - sum(have)
    step = missing // len(have) - max(per_shard)
    given = [max(0, step // size) * size for size in per_shard]
    missing -= sum(given)
    while missing >= per_shard[k := given.index(min(given))]:
        missing, given[k] = missing - per_shard[k], given[k] + per_shard[k]
    given[-1] += missing
    return [a + b for a, b in zip(have, given, strict=True)]
