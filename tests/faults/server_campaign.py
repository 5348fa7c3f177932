"""SIGKILL to the servers of local Ray clusters in the middle of jobs: raylet and GCS server."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from datagen.cluster.attempt_guard import notes_of_a_job
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import JobSummary, JobTotals, StopRequest
from datagen.cluster.ray_cluster import RaySettings
from datagen.cluster.ray_executor import ray_executor
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.reports.audit import account_for
from datagen.schemas.run import Run
from tests.cluster.simulated import Heard
from tests.faults.counted import SAMPLES_PER_SHARD, check_rows
from tests.faults.job import RandomRows, make_rows
from tests.made_runs import make_run

POLICY = RetryPolicy(backoff_s=0.05)
STOPPED = "stopped "


def kill_server(ray: Any, kind: str) -> bool:
    """SIGKILL, or SIGSTOP with `stopped `, to a server of this process's cluster; whether it lived."""
    (server,) = ray._private.worker._global_node.all_processes[kind.removeprefix(STOPPED)]
    if server.process.poll() is not None:
        return False
    process = psutil.Process(server.process.pid)
    process.suspend() if kind.startswith(STOPPED) else process.kill()
    return True


def one_job(run: Run, seconds: float, on_tick: Callable[[Any, JobTotals], None]) -> JobSummary:
    """Make the missing shards on a local cluster of two slots; `on_tick` is given Ray and the totals."""
    with notes_of_a_job() as notes, ray_executor(make_rows, RaySettings(workers=2)) as executor:
        import ray

        def make_task(order: AttemptOrder) -> RandomRows:
            return RandomRows(run.storage.url, seconds, order.shard, order.attempt, order.deadline_s, notes)

        heard = Heard(on_tick=lambda totals: on_tick(ray, totals))
        summary = drive(run.missing(), make_task, executor, RunRecorder(run), POLICY, heard, StopRequest())
    run.close_lost_attempts()
    return summary


def kill_servers(
    folder: Path, kind: str, kills: int, shards: int, seconds: float, rng: np.random.Generator
) -> dict[str, int]:
    """Kill a server so often while a run is made, resume the run where that ended a job, and check it.

    A run that is done before every kill was spent is extended.
    """
    run = make_run(folder / "run", n=shards * SAMPLES_PER_SHARD, shards=())
    killed = aborted = 0
    due = rng.integers(shards // 2)  # the next kill comes when more shards are committed

    def on_tick(ray: Any, totals: JobTotals) -> None:
        nonlocal killed, due
        if killed < kills and totals.in_flight and len(run.committed()) > due and kill_server(ray, kind):
            killed, due = killed + 1, len(run.committed()) + rng.integers(shards // 2)

    while run.missing() or killed < kills:
        if not run.missing():
            run.grow(run.n + shards * SAMPLES_PER_SHARD)
        summary = one_job(run, seconds, on_tick)
        assert summary.end == "complete" or (summary.end == "aborted" and summary.cause), summary
        aborted += summary.end == "aborted"
        assert aborted <= killed, "a job that nothing disturbed was aborted"
    waste = check_bytes_and_ledger(run)
    return {"kills": killed, "jobs aborted": aborted, "shards": len(run.planned()), "attempts wasted": waste}


def check_bytes_and_ledger(run: Run) -> int:
    """AssertionError where a finished run is not the undisturbed one, or its ledger not commits and waste.

    Returns how many attempts were wasted.
    """
    run = Run.open(run.storage.url)
    commits = list(run.commits())
    check_rows(run, commits)
    ends = {end.attempt: end.outcome for end in run.ledger.ends()}
    assert set(ends.values()) <= {"lost", "superseded"} and not ends.keys() & {c.attempt for c in commits}
    recorder = account_for([run])
    waste = sum(account.attempts for account in recorder.waste.values())
    assert recorder.useful.attempts == len(commits) and waste == len(ends)
    return waste
