"""Forecasts against worlds whose costs are drawn from the model: intervals hold as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.cluster.run_forecast import MadeShard, RunForecast, SeenCosts, shown_range
from datagen.cluster.shard_costs import Interval, ShardCosts, Variation, Work, warm_up_share
from datagen.schemas.run_records import Cost, Host

SPREAD = 0.5  # of one scene's cost


def shard_cost(rng: np.random.Generator, scenes: int, before: int, warm_up: float = 8.0) -> float:
    """A shard of log-normal scenes of 1 s, with a worker's warm-up (s) and 0.3 s for writing."""
    spread = np.log1p(SPREAD**2)
    drawn = rng.lognormal(-spread / 2, np.sqrt(spread), scenes).sum()
    return float(drawn + warm_up * warm_up_share(before, scenes) + 0.3)


def worker_costs(rng: np.random.Generator, shards: int, scenes: int, warm_up: float = 8.0) -> list[float]:
    return [shard_cost(rng, scenes, k * scenes, warm_up) for k in range(shards)]


@pytest.mark.parametrize(("pilot", "per", "jobs"), [(4, 4, 32), (4, 1, 4), (6, 8, 32)])
def test_the_interval_of_a_sum_holds_in_80_percent(pilot: int, per: int, jobs: int) -> None:
    """Two workers make a pilot of shards of `per` scenes, and a job of 20 shards of `jobs` scenes."""
    rng, held = np.random.default_rng(0), 0
    for _ in range(300):
        costs, warm_up = ShardCosts(Variation(SPREAD, 0.0)), abs(rng.normal(6.0, 6.0))
        for _ in range(2):
            for k, cost in enumerate(worker_costs(rng, pilot, per, warm_up)):
                costs.add(cost, per, k * per, fixed=0.3)
        truth = sum(sum(worker_costs(rng, 10, jobs, warm_up)) for _ in range(2))
        interval = Interval.of(costs.total(Work(20, jobs, 2 * warm_up_share(0, 10 * jobs))))
        held += interval.low <= truth <= interval.high
    assert 0.72 <= held / 300 <= 0.9


def test_known_shards_narrow_the_interval() -> None:
    costs = ShardCosts(Variation(SPREAD, 0.0))
    for k, cost in enumerate(worker_costs(np.random.default_rng(1), 8, 4)):
        costs.add(cost, 4, 4 * k, fixed=0.3)
    share = warm_up_share(0, 48)
    unknown, known = (Interval.of(costs.total(Work(12, 4, share, known))) for known in (False, True))
    assert known.high - known.low < 0.8 * (unknown.high - unknown.low)


@pytest.mark.parametrize(("shards", "workers"), [(3, 4), (12, 4), (200, 4), (500, 100)])
def test_the_makespan_is_that_of_shards_given_to_free_workers(shards: int, workers: int) -> None:
    costs = ShardCosts(Variation(0.3, 0.0))
    for _ in range(4000):
        costs.add(10.0, 10, 10**6)
    span = Interval.of(costs.makespan(Work(shards, 10), workers)).middle
    # Equal shards are made in waves; the prior leaves them slightly unequal.
    waves = -(-shards // workers)
    assert 0.9 * 10 * shards / workers <= span <= 1.15 * 10 * waves


def test_the_interval_of_a_run_narrows_as_it_goes_on() -> None:
    """Relative to what is left: the noise of the rest grows as the rate gets known."""
    narrowed = np.array([narrowing(np.random.default_rng(seed)) for seed in range(12)])
    assert (narrowed < 0.9).all() and narrowed.mean() < 0.8


def narrowing(rng: np.random.Generator) -> float:
    """The width of the interval after 60 of 100 shards, divided by that of the first interval."""
    forecast, host = RunForecast(16), Host(name="h", cpu="c", cores=2, memory_bytes=1)
    widths: list[float] = []
    for made in range(1, 61):
        cost = shard_cost(rng, 16, 1000)
        forecast.add(Cost(wall_s=cost, cpu_s=cost), host)
        left = forecast.left(100 - made, workers=1)
        assert (left is None) == (made < 3)
        if left is not None:
            widths.append((left.high - left.low) / left.middle)
            assert left.low < 16.3 * (100 - made) * 1.3
    return widths[-1] / widths[0]


def test_fixed_parts_do_not_grow_with_the_shards() -> None:
    seen = SeenCosts({name: Variation(0.01, 0.0) for name in ("cpu", "wall", "bytes")})
    for _ in range(50):
        cost = Cost(wall_s=5.0, cpu_s=2.0, written_bytes=4400)
        seen.add(MadeShard(4, cost, "w", fixed_bytes=400))
    assert Interval.of(seen.stored.total(Work(10, 32))).middle == pytest.approx(10 * 32_400, rel=0.01)


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=12), st.integers(1, 300), st.integers(1, 100))
def test_any_costs_give_a_finite_forecast(seen: list[float], shards: int, workers: int) -> None:
    """Also falling ones, which look as if a scene cost nothing, and zeros."""
    costs = ShardCosts(Variation(0.55, 0.15))
    for k, cost in enumerate(seen):
        costs.add(cost, 2, 2 * k)
    work = Work(shards, 2, 1.0)
    for draws in (costs.total(work), costs.makespan(work, workers, running=True)):
        interval = Interval.of(draws)
        assert 0 <= interval.low <= interval.middle <= interval.high < np.inf


def test_costs_that_fall_are_taken_for_a_warm_up() -> None:
    costs = ShardCosts(Variation(0.55, 0.0))
    for k, cost in enumerate([20.0, 4.0, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0]):
        costs.add(cost, 2, 2 * k)
    assert Interval.of(costs.total(Work(100, 2))).middle < 200.0  # the mean of all would be 380


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [(40, 55, "40-55 s"), (150, 200, "2.5-3.3 min"), (720, 900, "12-15 min"), (7600, 9400, "2.1-2.6 h")],
)
def test_a_range_of_time_has_one_unit(low: float, high: float, text: str) -> None:
    assert shown_range(Interval(low, (low + high) / 2, high)) == text
