"""A run's missing shards made, here or on a cluster, and what the user is told at the end."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass

from cluster.attempt import run_attempt
from cluster.books import RunBooks, close_lost_attempts
from cluster.driver import Order, drive
from cluster.executor import Executor
from cluster.inprocess import InProcessExecutor
from cluster.policy import Policy, too_many_quarantined
from cluster.progress import progress
from cluster.ray_cluster import RaySettings, ray_cluster
from cluster.ray_executor import RayExecutor
from cluster.stop import StopRequest, stop_on_signals
from cluster.tally import JobSummary, Tally
from cluster.task import ShardTask
from datagen.console import print_rows, seconds
from schemas.errors import InputError
from schemas.run import Run
from schemas.seal import seal


@dataclass(frozen=True)
class JobSettings:
    """Where a job runs and finds its sources; nothing of this changes a sample."""

    houses: str
    objects: str
    workers: int | None
    address: str
    json: bool
    scenes_from: str = ""  # the run whose scenes are labelled again; "" draws new ones


def run_job(run: Run, settings: JobSettings) -> JobSummary:
    """Make every missing shard of the run, here or on a Ray cluster."""
    missing = run.missing()
    layout, spec = run.layout, run.manifest.spec
    done = len(run.planned()) - len(missing)
    if not missing:
        close_lost_attempts(run)
        given_up, shards = run.quarantined() & set(run.planned()), len(run.planned())
        failed = too_many_quarantined(Policy(), len(given_up), shards)
        return JobSummary("failed" if failed else "complete", "", Tally(0), 0.0)
    stop = StopRequest()
    with ExitStack() as stack:
        # Local paths travel to workers of this machine; on a cluster they are shared by all nodes.
        notes = stack.enter_context(tempfile.TemporaryDirectory(prefix="datagen-notes-"))

        def make_task(order: Order) -> ShardTask:
            return ShardTask(
                run=run.storage.url,
                spec=spec,
                layout=layout,
                shard=order.shard,
                attempt=order.attempt,
                houses=settings.houses,
                objects=settings.objects,
                deadline_s=order.deadline_s,
                memory_factor=order.memory_factor,
                notes=notes,
                scenes_from=settings.scenes_from,
            )

        executor = _executor(settings, len(missing), stack)
        stack.enter_context(stop_on_signals(stop, interrupt=settings.workers == 0))
        display = stack.enter_context(
            progress(layout.samples_per_shard, len(missing), done, True if settings.json else None)
        )
        summary = drive(missing, make_task, executor, RunBooks(run), Policy(), display, stop)
    # What a killed driver left open is closed last: its workers may outlive it and still commit.
    close_lost_attempts(run)
    return summary


def _executor(settings: JobSettings, shards: int, stack: ExitStack) -> Executor[ShardTask]:
    if settings.workers == 0:
        return InProcessExecutor(run_attempt)
    cores = len(os.sched_getaffinity(0))
    workers = min(settings.workers or cores, shards)  # Ray starts them all at once
    ray_settings = RaySettings(address=settings.address, workers=workers)
    return RayExecutor(run_attempt, ray_settings, stack.enter_context(ray_cluster(ray_settings)))


def finish(run: Run, summary: JobSummary, out: str) -> int:
    """Seal what there is, say how it went and how to go on; return the exit code."""
    tally = summary.tally
    n, given_up = run.n, sorted(run.quarantined())
    if tally.shards:
        labels = f"{tally.labels:,} new, {n:,} wanted"
    elif given_up:
        labels = f"nothing to do: the shards of {n:,} labels are made or given up"
    else:
        labels = f"nothing to do: all {n:,} labels are there"
    rows = [
        ("labels", labels),
        ("positive", f"{100 * tally.positives / tally.labels:.1f}%" if tally.labels else "-"),
        ("time", f"{seconds(summary.elapsed_s)}" + _rate(summary)),
        ("retries", str(tally.retries)),
    ]
    if given_up:
        shown = (
            f"{len(given_up)} shards, {given_up[:10]}: remove {shlex.quote(f'{out}/quarantine')} to try again"
        )
        rows.append(("quarantined", shown))
    if summary.end in ("complete", "failed") and run.committed():
        sealed = seal(run.storage)
        rows.append(("store", f"{sealed}: zarr.open or xarray.open_zarr reads it"))
    print_rows(f"{summary.end}: {out}", rows)
    if summary.end == "aborted":
        raise InputError(
            out, "", f"the job cannot go on: {summary.cause}", f"Then resume: {resume_command()}"
        )
    if summary.end == "failed":
        causes = Counter(record.causes[-1] for record in run.quarantine_records() if record.causes)
        most = f", most often by: {causes.most_common(1)[0][0]}" if causes else ""
        sys.stderr.write(
            f"error: {out}: too many shards failed{most}. See: datagen status {shlex.quote(out)}\n"
        )
    if summary.end == "interrupted":
        sys.stderr.write(
            f"interrupted with {summary.remaining} shards to go. Resume with:\n  {resume_command()}\n"
        )
    return summary.exit_code


def resume_command() -> str:
    """The command line that goes on with this run: the one that began it."""
    return shlex.join(["datagen", *sys.argv[1:]])


def _rate(summary: JobSummary) -> str:
    if not summary.tally.labels or summary.elapsed_s <= 0:
        return ""
    return f", {summary.tally.labels / summary.elapsed_s:,.0f} labels/s"
