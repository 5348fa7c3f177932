"""A worker that fills the machine's memory is ended by Ray, and its shard tried once more."""

from __future__ import annotations

import os
from pathlib import Path

import psutil
import pytest

from datagen.cluster.attempt_guard import notes_of_a_job
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import JobSummary, StopRequest
from datagen.cluster.ray_cluster import RaySettings, ray_cluster
from datagen.cluster.ray_executor import RayExecutor
from datagen.cluster.shard_policy import RetryPolicy
from tests.cluster.simulated import Heard, PaperRecorder
from tests.faults.scripted import FILL_BYTES, ScriptedTask, perform

pytestmark = pytest.mark.slow


def test_a_worker_that_fills_the_memory_is_ended_and_its_shard_retried_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(4):  # another program that grows or ends meanwhile moves the threshold
        (tmp_path / str(number)).mkdir()
        summary, recorder, stood_still = fill_the_memory(tmp_path / str(number), monkeypatch)
        if stood_still:
            break
    assert summary.totals.committed == 1 and summary.totals.retries == 1
    ended, committed = recorder.entries
    assert (ended.outcome, committed.outcome) == ("out_of_memory", "committed")
    assert "memory" in ended.cause and ended.host is not None and ended.host.pid != os.getpid()
    assert ended.cost is not None and ended.cost.wall_s > 0


def fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[JobSummary, PaperRecorder, bool]:
    """How a job ended, its ledger, and whether other programs' memory stayed the same meanwhile."""
    from ray._private.utils import get_system_memory, get_used_memory

    total = get_system_memory()
    # Ray counts by the limits of a container where there are some, or else as the system does.
    used = max(get_used_memory(), total - psutil.virtual_memory().available)
    if total - used < 2 * FILL_BYTES:
        pytest.skip("too little free memory to fill some of it")
    # As if the machine ended at half of what will be filled.
    threshold = (used + FILL_BYTES / 2) / total
    monkeypatch.setenv("RAY_memory_usage_threshold", f"{threshold:.4f}")
    monkeypatch.setenv("RAY_memory_monitor_refresh_ms", "100")
    (tmp_path / "tries").mkdir()
    settings, recorder = RaySettings(workers=1), PaperRecorder()
    with notes_of_a_job() as notes, ray_cluster(settings) as ray:

        def make_task(order: AttemptOrder) -> ScriptedTask:
            tries = str(tmp_path / "tries")
            return ScriptedTask(0, order.attempt, 200, notes, ("fill_memory",), tries)

        policy = RetryPolicy(max_quarantined_share=1.0, backoff_s=0.05)
        summary = drive(
            [0], make_task, RayExecutor(perform, settings, ray), recorder, policy, Heard(), StopRequest()
        )
    now = max(get_used_memory(), total - psutil.virtual_memory().available)
    return summary, recorder, abs(now - used) <= FILL_BYTES / 4
