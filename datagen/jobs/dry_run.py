"""`--dry-run`: forecast the shards and the cost of a job without running it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.cluster.shard_costs import Draws, Interval, Work, warm_up_share
from datagen.jobs.evidence import Evidence, earlier_run, own_costs
from datagen.jobs.forecast import Forecast
from datagen.jobs.job_report import JobResult
from datagen.jobs.options import JobOptions
from datagen.jobs.pilot import run_pilot, worker_count
from datagen.reports.prices import read_prices
from datagen.reports.specification_summary import made_from
from datagen.schemas.run import Run
from datagen.schemas.run_records import Manifest

# Seconds from the opened sources to the first shard of a job on Ray, where no pilot has measured it.
_RAY_START_S = 5.0


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """One run of a job that is not started. `shards`: number to make. `run` is None before it exists."""

    manifest: Manifest
    run: Run | None
    n: int
    shards: int
    houses: str  # source references, absolute
    objects: str
    scenes_from: str = ""


def dry_run(path: str, planned: Sequence[PlannedRun], job_options: JobOptions, began_s: float) -> JobResult:
    """Forecast the cost of these runs. No file is written at `path`.

    A pilot runs where this machine made no shards of a run, nor of one like it.
    """
    workers = worker_count(job_options)
    shards = sum(each.shards for each in planned)
    if not shards:
        return JobResult(
            path, "complete", sum(each.n for each in planned), made_from(p.manifest for p in planned)
        )
    cpu_s, stored, wall_s, texts = (np.zeros(1), np.zeros(1), np.zeros(1), dict[str, None]())
    for each in planned:
        if each.shards:
            evidence = _evidence(path, each, job_options, began_s)
            work = _work(each, evidence, workers)
            costs = evidence.costs
            cpu_s = cpu_s + costs.cpu.total(work)
            stored = stored + costs.stored.total(work)
            start_s = 0.0 if wall_s.any() else evidence.start_s
            wall_s = wall_s + start_s + costs.wall.makespan(work, workers)
            texts[evidence.text] = None
    prices = read_prices(job_options.prices)
    money = prices.cost_of(cpu_s=1.0) * cpu_s + prices.cost_of(stored_bytes=1.0) * stored
    forecast = Forecast(
        shards=shards,
        scenes=sum(each.shards * each.manifest.layout.scenes_per_shard for each in planned),
        labels=sum(each.shards * each.manifest.layout.samples_per_shard for each in planned),
        workers=max(1, min(workers, shards)),
        wall_s=Interval.of(wall_s),
        cpu_s=Interval.of(cpu_s),
        stored_bytes=Interval.of(stored),
        money=Interval.of(money),
        prices=prices,
        evidence="; ".join(texts),
        budget=job_options.budget or "",
        within_budget=_within(job_options, wall_s, cpu_s, stored),
    )
    return JobResult(
        path=path,
        end="dry-run",
        n=sum(each.n for each in planned),
        made_from=made_from(each.manifest for each in planned),
        shards=shards,
        remaining=shards,
        forecast=forecast,
    )


def _evidence(path: str, planned: PlannedRun, job_options: JobOptions, began_s: float) -> Evidence:
    start_s = time.monotonic() - began_s + (0.0 if job_options.workers == 0 else _RAY_START_S)
    if planned.run is not None and (costs := own_costs(planned.run)) is not None:
        return Evidence(f"{costs.seen} shards of this run, made on this machine", costs, start_s)
    earlier = earlier_run(path, planned.manifest)
    if earlier is not None:
        run, costs = earlier
        name = Path(run.storage.url).name
        return Evidence(f"{costs.seen} shards of {name}, made on this machine", costs, start_s)
    scenes = planned.shards * planned.manifest.layout.scenes_per_shard
    sources = (planned.houses, planned.objects, planned.scenes_from)
    evidence = run_pilot(planned.manifest, sources, scenes, job_options, began_s)
    if planned.run is None or not planned.run.committed():
        return evidence
    return Evidence(evidence.text, evidence.costs, evidence.start_s)  # the pilot's scenes are made already


def _work(planned: PlannedRun, evidence: Evidence, workers: int) -> Work:
    layout = planned.manifest.layout
    busy = max(1, min(workers, planned.shards))
    each = planned.shards * layout.scenes_per_shard / busy
    warm_ups = busy * warm_up_share(0, each)
    return Work(planned.shards, layout.scenes_per_shard, warm_ups, known=evidence.known)


def _within(job_options: JobOptions, wall_s: Draws, cpu_s: Draws, stored: Draws) -> float | None:
    """The probability that the job ends within its budget; None without one."""
    budget = job_options.limit
    if budget is None:
        return None
    if budget.wall_s is not None:
        return float(np.mean(wall_s <= budget.wall_s))
    spending = budget.per_cpu_s * cpu_s + budget.per_byte * stored
    return float(np.mean(spending <= (budget.spending or 0.0)))
