"""A pilot: a few small shards of a run in a temporary folder, to measure the cost of the run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from tempfile import TemporaryDirectory

from datagen.cluster.run_forecast import BETWEEN_JOBS, SeenCosts
from datagen.jobs.evidence import Evidence, made_here
from datagen.jobs.job import JobPlan, JobRun, make_missing, open_recorder
from datagen.jobs.options import JobOptions
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout, Manifest
from datagen.schemas.storage import open_storage

# A pilot's shards are small, so that each worker makes several; the first scenes of a worker cost more.
_CANDIDATES_PER_SHARD, _SHARDS_PER_WORKER = 240, 4
_LIMIT = "2min"  # further shards are not begun after that; each worker makes one in any case


def pilot_layout(layout: Layout, scenes: int, workers: int) -> tuple[Layout, int]:
    """Layout and number of shards of a pilot: about a third of a small job's scenes."""
    per_shard = max(1, min(layout.scenes_per_shard, _CANDIDATES_PER_SHARD // layout.candidates_per_scene))
    most = max(2, scenes // 3)
    per_shard = max(1, min(per_shard, most // (_SHARDS_PER_WORKER * workers)))
    shards = max(2, min(_SHARDS_PER_WORKER * workers, most // per_shard))
    return Layout(scenes_per_shard=per_shard, candidates_per_scene=layout.candidates_per_scene), shards


def worker_count(job_options: JobOptions) -> int:
    """Workers of a job on this machine."""
    return 1 if job_options.workers == 0 else job_options.workers or len(os.sched_getaffinity(0))


def run_pilot(
    manifest: Manifest,
    sources: Sequence[str],
    scenes: int,
    job_options: JobOptions,
    began_s: float,
) -> Evidence:
    """Make the first shards of a job of `scenes` scenes. Only the caches of this machine keep traces of them.

    `sources` are houses, objects and the run with the scenes. InputError where a shard cannot be made.
    """
    if job_options.address != "local":
        problem = "workers of a cluster cannot see the temporary folder of a pilot"
        fix = (
            "Make a few shards first (a small --n) and forecast the rest: datagen extend RUN --n N --dry-run"
        )
        raise InputError("--dry-run", job_options.address, problem, fix)
    workers = worker_count(job_options)
    layout, shards = pilot_layout(manifest.layout, scenes, workers)
    if job_options.workers != 0:
        job_options = replace(job_options, workers=min(workers, shards))
    job_options = replace(job_options, dry_run=False, budget=_LIMIT)
    # A shard that is killed at Ctrl-C may still write: the system removes files that are left.
    with TemporaryDirectory(prefix="datagen-pilot-", ignore_cleanup_errors=True) as folder:
        small = manifest.model_copy(update={"layout": layout})
        run = Run.create_or_open(open_storage(folder), small, shards * layout.samples_per_shard)
        plan = JobPlan(run.storage, folder, [JobRun(run, *sources)], job_options, began_s, (), ())
        summary = make_missing(plan, open_recorder(plan))
        made = made_here(run)
    if summary.end == "interrupted":
        raise KeyboardInterrupt
    if summary.end == "aborted" or not made:
        raise InputError("--dry-run", "", f"the pilot made no shard: {summary.cause}", "Correct this first")
    costs = SeenCosts(BETWEEN_JOBS)
    for shard in made:
        costs.add(shard)
    size = (
        f"{len(made)} shards of {layout.scenes_per_shard}" if layout.scenes_per_shard > 1 else f"{len(made)}"
    )
    noun = "scenes" if layout.scenes_per_shard > 1 or len(made) > 1 else "scene"
    return Evidence(f"a pilot of {size} {noun}, not kept", costs, summary.start_s, known=True)
