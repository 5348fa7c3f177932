"""Several real drivers of one run on a simulated cluster: each shard once, little made twice.

They take turns, in the order of simulated time.
"""

from __future__ import annotations

import random
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptReport, JobSummary, StopRequest
from datagen.cluster.shard_policy import OpenShards, RetryPolicy
from datagen.schemas.shard_ranges import ShardRanges
from tests.cluster.simulated import FakeClock, Fate, Heard, PaperRecorder, SimulatedExecutor

SHARD_S, LOOK_S = 5.0, 0.01


class Turns:
    """Lets one thread at a time run: that whose own clock is furthest behind."""

    def __init__(self, clocks: list[FakeClock]) -> None:
        self._clocks, self._left = clocks, set(range(len(clocks)))
        self._changed = threading.Condition()

    def wait_for(self, driver: int) -> None:
        with self._changed:
            self._changed.notify_all()
            self._changed.wait_for(
                lambda: min(self._left, key=lambda d: (self._clocks[d].now_s, d)) == driver
            )

    def end(self, driver: int) -> None:
        with self._changed:
            self._left.discard(driver)
            self._changed.notify_all()


class Executor(SimulatedExecutor):
    """One driver's workers; a shard is won by who is through with it first. `done_s`: when each shard is."""

    def __init__(self, done_s: dict[int, float], turns: Turns, driver: int, clock: FakeClock) -> None:
        super().__init__(clock, self.begin, slots=2)
        self.done_s, self.turns, self.driver = done_s, turns, driver

    def begin(self, order: AttemptOrder, n: int) -> Fate:
        if order.shard in self.done_s:  # who began first is through with it first
            return ("superseded", LOOK_S if self.done_s[order.shard] <= self.clock.now_s else SHARD_S)
        self.done_s[order.shard] = self.clock.now_s + SHARD_S
        return ("committed", SHARD_S)

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        ended = super().wait(timeout_s)
        self.turns.wait_for(self.driver)
        return ended


class SharedRecorder(PaperRecorder):
    """The recorder of one driver over what all have committed."""

    def __init__(self, shards: int, done_s: dict[int, float], clock: FakeClock) -> None:
        super().__init__()
        self.shards, self.done_s, self.clock = shards, done_s, clock

    def missing(self) -> ShardRanges:
        done = {shard for shard, at_s in self.done_s.items() if at_s <= self.clock.now_s}
        return ShardRanges.of(set(range(self.shards)) - done)


def drive_together(drivers: int, shards: int) -> list[JobSummary]:
    """How the jobs of drivers that begin together at one run ended."""
    clocks = [FakeClock() for _ in range(drivers)]
    done_s, turns, ended = dict[int, float](), Turns(clocks), dict[int, JobSummary]()

    def one(driver: int) -> None:
        clock = clocks[driver]
        executor, recorder = Executor(done_s, turns, driver, clock), SharedRecorder(shards, done_s, clock)
        try:
            turns.wait_for(driver)
            ended[driver] = drive(
                range(shards), lambda o: o, executor, recorder, RetryPolicy(), Heard(), StopRequest(), clock
            )
        finally:
            turns.end(driver)

    threads = [threading.Thread(target=one, args=(driver,)) for driver in range(drivers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [ended[driver] for driver in range(drivers)]


@given(st.sets(st.integers(0, 80)), st.integers(0, 2**32), st.lists(st.integers(0, 3), max_size=80))
def test_open_shards_are_given_once_or_dropped(shards: set[int], seed: int, moves: list[int]) -> None:
    rng, open_ = random.Random(seed), OpenShards(sorted(shards), random.Random(seed))
    given_out: list[int] = []
    dropped: set[int] = set()
    for move in moves:
        if move == 0:
            open_.go_elsewhere()
        elif move == 1:
            gone = {shard for shard in shards if rng.random() < 0.2}
            dropped |= gone - set(given_out)
            before = len(open_)
            assert open_.keep(ShardRanges.of(shards - gone)) == before - len(open_)
        elif (shard := open_.next()) is not None:
            given_out.append(shard)
    while (shard := open_.next()) is not None:
        given_out.append(shard)
    assert len(open_) == 0 and len(set(given_out)) == len(given_out)
    assert set(given_out) | dropped == shards and not set(given_out) & dropped


@pytest.mark.parametrize(
    ("drivers", "shards", "attempts", "share"),
    # Wasted attempts and their share of all time, at most, in the mean. Two slots and four attempts in
    # flight a driver: of ten shards, four drivers cannot but make some twice.
    [(2, 10, 11, 0.36), (4, 10, 23, 0.53), (2, 100, 22, 0.11), (4, 100, 48, 0.19)],
)
def test_drivers_that_begin_together_waste_little(
    drivers: int, shards: int, attempts: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = np.random.default_rng(0)
    monkeypatch.setattr("datagen.cluster.driver.secrets.token_hex", lambda n: names.bytes(n).hex())
    wasted = []
    for _ in range(12):
        summaries = drive_together(drivers, shards)
        assert sum(summary.totals.committed for summary in summaries) == shards
        assert all(summary.end == "complete" and not summary.remaining for summary in summaries)
        totals = [summary.totals for summary in summaries]
        wasted_s = sum(t.wasted_wall_s for t in totals)
        of_all = wasted_s / (wasted_s + sum(t.useful_wall_s for t in totals))
        wasted.append((sum(t.outcomes.total() - t.committed for t in totals), of_all))
    assert np.all(np.mean(wasted, axis=0) <= (attempts, share))


def test_open_shards_come_in_order_without_another_driver() -> None:
    for seed in range(20):
        open_ = OpenShards([7, 3, 4, 1], random.Random(seed))
        given_out = [open_.next() for _ in range(5)]
        assert given_out[4] is None and sorted(given_out[:4]) == [1, 3, 4, 7]
        at = given_out.index(1)
        assert given_out[at:4] + given_out[:at] == [1, 3, 4, 7]  # from the first one behind the last
    open_ = OpenShards(range(10), random.Random(0))
    at = open_.next()
    assert open_.next() == (at + 1) % 10
    left = [(at + ahead) % 10 for ahead in (2, 3, 8, 9)]
    assert open_.keep(ShardRanges.of(left)) == 4  # others are far ahead: it stays here
    assert [open_.next() for _ in range(5)] == [*left, None]
