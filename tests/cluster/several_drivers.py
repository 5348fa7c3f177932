"""Several real drivers of one run on a simulated cluster: they take turns, in the order of simulated time."""

from __future__ import annotations

import threading
from typing import TypeVar

from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptReport, JobSummary, StopRequest
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.run_records import ShardRanges
from tests.cluster.simulated import FakeClock, Fate, Heard, PaperRecorder, SimulatedExecutor

T = TypeVar("T")
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


class Shared:
    """Who has committed what, and when."""

    def __init__(self, shards: int) -> None:
        self.shards, self.done_s = shards, dict[int, float]()

    def is_done(self, shard: int, at_s: float) -> bool:
        return self.done_s.get(shard, float("inf")) <= at_s


class Executor(SimulatedExecutor):
    """One driver's workers; a shard is won by who is through with it first."""

    def __init__(self, shared: Shared, turns: Turns, driver: int, clock: FakeClock, slots: int) -> None:
        super().__init__(clock, self.begin, slots, keep_orders=True)
        self.shared, self.turns, self.driver = shared, turns, driver

    def begin(self, order: AttemptOrder, n: int) -> Fate:
        now_s = self.clock.now_s
        if self.shared.is_done(order.shard, now_s):
            return ("superseded", LOOK_S)
        if order.shard in self.shared.done_s:  # who began first is through with it first
            return ("superseded", SHARD_S)
        self.shared.done_s[order.shard] = now_s + SHARD_S
        return ("committed", SHARD_S)

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        ended = super().wait(timeout_s)
        self.turns.wait_for(self.driver)
        return ended


class SharedRecorder(PaperRecorder):
    """The recorder of one driver over what all have committed."""

    def __init__(self, shared: Shared, clock: FakeClock) -> None:
        super().__init__()
        self.shared, self.clock = shared, clock

    def missing(self) -> ShardRanges:
        now_s = self.clock.now_s
        return ShardRanges.of([s for s in range(self.shared.shards) if not self.shared.is_done(s, now_s)])


def drive_together(drivers: int, shards: int, slots: int = 2) -> list[JobSummary]:
    """How the jobs of drivers that begin together at one run ended."""
    clocks = [FakeClock() for _ in range(drivers)]
    shared, turns, ended = Shared(shards), Turns(clocks), dict[int, JobSummary]()

    def one(driver: int) -> None:
        executor = Executor(shared, turns, driver, clocks[driver], slots)
        recorder, clock = SharedRecorder(shared, clocks[driver]), clocks[driver]
        try:
            turns.wait_for(driver)
            ended[driver] = drive(
                range(shards), _same, executor, recorder, RetryPolicy(), Heard(), StopRequest(), clock
            )
        finally:
            turns.end(driver)

    threads = [threading.Thread(target=one, args=(driver,)) for driver in range(drivers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [ended[driver] for driver in range(drivers)]


def _same(order: T) -> T:
    return order


def waste(summaries: list[JobSummary]) -> tuple[int, float]:
    """Attempts that were wasted, and the share of all time that they took."""
    wasted = sum(summary.totals.outcomes.total() - summary.totals.committed for summary in summaries)
    useful_s = sum(summary.totals.useful_wall_s for summary in summaries)
    wasted_s = sum(summary.totals.wasted_wall_s for summary in summaries)
    return wasted, wasted_s / (useful_s + wasted_s)
