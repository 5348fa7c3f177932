"""Budgets by scripted times: no shard begins that would not fit, and all that fit are made."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.cluster.budget import Budget, BudgetGuard, ends_in_time
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.job_progress import JobMonitor, TimeLeft
from datagen.cluster.job_totals import JobSummary
from datagen.cluster.retry_policy import RetryPolicy
from datagen.cluster.run_forecast import RunForecast
from datagen.cluster.stop_request import StopRequest
from datagen.schemas.run_records import Cost
from tests.cluster.simulated import FakeClock, Fate, Heard, PaperRecorder, SimulatedExecutor
from tests.cluster.test_job_monitor import PaperBoard

SHARD_S = 10.0  # wall seconds; a scripted shard uses half of them as CPU seconds
SCENES = 32


def made_within(
    budget: Budget, shards: int = 1000, slots: int = 4, outcomes: dict[int, str] | None = None
) -> tuple[JobSummary, float]:
    """The summary of a job with this budget, and when it ended."""
    clock, stop = FakeClock(), StopRequest()

    def fate(order: AttemptOrder, n: int) -> Fate:
        return (outcomes or {}).get(order.shard, "committed") if n == 1 else "committed", SHARD_S

    executor = SimulatedExecutor(clock, fate, slots=slots)
    forecast = RunForecast(SCENES)
    guard = BudgetGuard(budget, began_s=0.0)
    guard.use(forecast)
    left = TimeLeft(forecast, lambda: slots)
    events = JobMonitor(PaperBoard(clock), stop, 10, Heard(), left, clock)
    summary = drive(
        range(shards), lambda o: o, executor, PaperRecorder(), RetryPolicy(), events, stop, clock, guard
    )
    return summary, clock.now_s


def test_a_job_within_its_budget_is_complete() -> None:
    summary, _ = made_within(Budget("2h", wall_s=7200.0), shards=40)
    assert summary.end == "complete" and summary.totals.committed == 40


@pytest.mark.parametrize("limit_s", [100.0, 305.0, 1234.0])
def test_a_time_ends_before_the_first_shard_that_does_not_fit(limit_s: float) -> None:
    summary, ended_s = made_within(Budget("t", wall_s=limit_s))
    assert summary.end == "budget" and summary.exit_code == 3 and summary.totals.in_flight == 0
    assert summary.cause == "no further shard fits the budget of t"
    assert ended_s <= limit_s + 0.5 and ended_s >= limit_s - 2.2 * SHARD_S
    # All workers work until no whole shard fits.
    assert 4 * (limit_s // SHARD_S - 2) <= summary.totals.committed <= 4 * (limit_s // SHARD_S)
    assert set(summary.totals.outcomes) == {"committed"}


@pytest.mark.parametrize("limit", [60.0, 333.0, 2000.0])
def test_cpu_seconds_are_never_exceeded_by_equal_shards(limit: float) -> None:
    summary, _ = made_within(Budget("c", spending=limit))
    spent = summary.totals.useful_cpu_s
    assert summary.end == "budget" and spent <= limit and spent >= limit - 3 * SHARD_S / 2


def test_failed_attempts_are_paid_from_the_budget() -> None:
    bad = dict.fromkeys(range(1000), "crashed")
    summary, _ = made_within(Budget("c", spending=400.0), outcomes=bad)
    assert summary.totals.wasted_cpu_s > 0
    assert summary.totals.useful_cpu_s + summary.totals.wasted_cpu_s <= 400.0


def test_a_shard_that_is_known_not_to_fit_never_begins() -> None:
    clock, guard = FakeClock(), BudgetGuard(Budget("5s", wall_s=5.0), began_s=0.0)
    forecast = RunForecast(SCENES)
    forecast.add(Cost(wall_s=SHARD_S, cpu_s=SHARD_S), None)
    guard.use(forecast)
    executor = SimulatedExecutor(clock, lambda o, n: ("committed", SHARD_S), keep_orders=True)
    summary = drive(
        range(9),
        lambda o: o,
        executor,
        PaperRecorder(),
        RetryPolicy(),
        Heard(),
        StopRequest(),
        clock,
        guard,
    )
    assert summary.end == "budget" and executor.orders == [] and summary.remaining == 9


def test_before_a_cost_is_known_each_worker_gets_one_shard() -> None:
    guard = BudgetGuard(Budget("1h", wall_s=3600.0), began_s=0.0)
    guard.use(RunForecast(SCENES))
    assert guard.allows(1.0, [0.0] * 3, slots=4) and not guard.allows(1.0, [0.0] * 4, slots=4)
    assert not guard.allows(3600.0, [], slots=4)


def test_a_second_wave_waits_for_the_first() -> None:
    assert ends_in_time(20.0, 0.0, [0.0, 0.0], slots=2, shard_s=10.0)
    assert not ends_in_time(20.0, 0.0, [0.0, 0.0, None, None], slots=2, shard_s=10.0)
    assert ends_in_time(20.0, 0.0, [0.0, 0.0, None], slots=2, shard_s=10.0)
    assert not ends_in_time(19.0, 9.5, [], slots=2, shard_s=10.0)


@given(st.floats(0, 1e4), st.lists(st.floats(0, 100), max_size=4), st.integers(0, 6), st.floats(0.1, 1e3))
def test_more_time_never_forbids_a_shard(
    limit_s: float, begun: list[float], waiting: int, shard_s: float
) -> None:
    flights = [*begun, *[None] * waiting]
    if ends_in_time(limit_s, 100.0, flights, 4, shard_s):
        assert ends_in_time(limit_s + 1, 100.0, flights, 4, shard_s)
        assert limit_s >= 100.0 + shard_s - 1e-6
