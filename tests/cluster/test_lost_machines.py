"""The driver where machines are lost with all they were at: whose fault is it?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptReport, JobSummary, StopRequest
from tests.cluster.simulated import (
    LENIENT,
    FakeClock,
    Fate,
    Heard,
    PaperRecorder,
    SimulatedExecutor,
    report_of,
)


@pytest.fixture(autouse=True)
def names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers draw their names, and by them their first shard, the same way in every run of these tests."""
    drawn = np.random.default_rng(0)
    monkeypatch.setattr("datagen.cluster.driver.secrets.token_hex", lambda n: drawn.bytes(n).hex())


class OneMachine(SimulatedExecutor):
    """A machine that loses all that it has been given whenever one attempt is lost."""

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        ended = super().wait(timeout_s)
        if any(report.outcome == "lost" for report in ended):
            ended += [report_of(order, "lost", 0.0) for order in [*self._running.values(), *self._queue]]
            self._running.clear()
            self._queue.clear()
        return ended


def on_one_machine(
    shards: int, fate: Callable[[AttemptOrder, int], Fate]
) -> tuple[JobSummary, PaperRecorder, OneMachine]:
    clock, recorder = FakeClock(), PaperRecorder()
    executor = OneMachine(clock, fate, keep_orders=True)
    summary = drive(range(shards), lambda o: o, executor, recorder, LENIENT, Heard(), StopRequest(), clock)
    assert len(recorder.entries) == len(executor.orders) == summary.totals.outcomes.total()
    return summary, recorder, executor


@pytest.mark.parametrize("shards", [2, 7, 300])
def test_an_executor_that_loses_everything_ends_the_job_and_is_no_shards_fault(shards: int) -> None:
    made = 0

    def fate(order: AttemptOrder, n: int) -> Fate:
        nonlocal made
        made += shards > 2
        return ("committed", 5.0) if 0 < made <= 3 else ("lost", 0.01)

    summary, recorder, executor = on_one_machine(shards, fate)
    assert summary.end == "aborted" and not recorder.given_up
    assert summary.cause == "every attempt is lost, the last by: scripted lost"
    assert summary.remaining == shards - summary.totals.committed and len(executor.orders) < 60


def test_an_executor_that_works_again_completes_the_job() -> None:
    began = 0

    def fate(order: AttemptOrder, n: int) -> Fate:
        nonlocal began
        began += 1
        return ("lost", 0.1) if began % 40 < 4 else ("committed", 5.0)

    summary, recorder, _ = on_one_machine(300, fate)
    assert summary.end == "complete" and summary.totals.committed == 300 and not recorder.given_up


@pytest.mark.parametrize(("shards", "wall_s"), [(1, 1.0), (30, 0.01), (30, 20.0)])
def test_a_shard_that_takes_its_machine_along_is_given_up_alone(shards: int, wall_s: float) -> None:
    # Wherever among the others it is begun: the driver begins at a random shard.
    for bad in range(shards):

        def fate(order: AttemptOrder, n: int, bad: int = bad) -> Fate:
            return ("lost", wall_s) if order.shard == bad else ("committed", 5.0)

        summary, recorder, executor = on_one_machine(shards, fate)
        assert set(recorder.given_up) == {bad} and summary.totals.committed == shards - 1
        assert len(executor.orders) <= shards + 11 * 8
        assert max(Counter(e.shard for e in recorder.entries if e.shard != bad).values(), default=0) <= 5
