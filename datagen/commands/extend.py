"""`datagen extend`: raise the number of labels of a run, or of merged runs, and make them."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heapify, heapreplace
from typing import Unpack

from datagen.configuration.stored_scenes import StoredScenes, refuse_too_few
from datagen.console.command_lines import prints
from datagen.console.options import AS_FOUND, RunPath, Sources, Whole
from datagen.jobs.dry_run import PlannedRun
from datagen.jobs.job import JobRun
from datagen.jobs.job_report import JobResult, print_job
from datagen.jobs.options import JobKeywords, JobOptions, absolute_path, refuse_odd_n
from datagen.jobs.start_job import continue_job, planned_run, source_words
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run


@prints(print_job)
def extend(run: RunPath, /, *, n: Whole, given: Sources = AS_FOUND, **job: Unpack[JobKeywords]) -> JobResult:
    """Raise the number of labels of a run to n and make the missing ones; existing shards keep their bytes.

    In merged runs, the new labels are divided evenly among the parts, in whole shards.

    For example: datagen extend runs/first --n 360,000

    Args:
        n: Labels wanted in total; not fewer than now.
    """
    job_options = JobOptions(**job)
    job_options.refuse_bad()
    refuse_odd_n(n)
    words = ["extend", absolute_path(run), "--n", str(n), *source_words(given), *job_options.words()]

    def wanted_of(job_runs: Sequence[JobRun]) -> list[int]:
        wanted = longer([job_run.run for job_run in job_runs], n, run)
        for job_run, more in zip(job_runs, wanted, strict=True):
            if job_run.scenes_from:
                stored = StoredScenes(Run.open(job_run.scenes_from), job_run.houses, job_run.objects)
                refuse_too_few(stored, job_run.run.layout, more)
        return wanted

    def grow(job_runs: Sequence[JobRun]) -> None:
        for job_run, more in zip(job_runs, wanted_of(job_runs), strict=True):
            job_run.run.grow(more)

    def planned(job_runs: Sequence[JobRun]) -> list[PlannedRun]:
        return [planned_run(*each) for each in zip(job_runs, wanted_of(job_runs), strict=True)]

    return continue_job(words, run, given, job_options, grow, planned)


def longer(runs: Sequence[Run], n: int, path: str) -> list[int]:
    """Return the number of labels of each run for n in total. InputError where n is smaller than now."""
    have = [run.n for run in runs]
    if n < sum(have):
        problem = f"{path} already has {sum(have):,} planned, and a run never shrinks"
        raise InputError("--n", str(n), problem, f"Give {sum(have)} or more")
    return shares(have, [run.layout.samples_per_shard for run in runs], n)


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
    heap = [(labels, k) for k, labels in enumerate(given)]
    heapify(heap)
    while missing >= per_shard[heap[0][1]]:
        labels, k = heap[0]
        missing, given[k] = missing - per_shard[k], labels + per_shard[k]
        heapreplace(heap, (given[k], k))
    given[-1] += missing
    return [a + b for a, b in zip(have, given, strict=True)]
