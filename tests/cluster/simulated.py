"""A cluster that exists only in numbers: time passes when the driver waits."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from datagen.cluster.driver import AttemptOrder
from datagen.cluster.protocol import AttemptReport, JobTotals
from datagen.cluster.shard_policy import RetryPolicy, ShardFailures
from datagen.schemas.run_records import Commit, Cost, FileEntry, Host, LedgerEntry
from datagen.schemas.shard_ranges import ShardRanges

# How an attempt ends, and the seconds it takes; None never ends by itself.
Fate = tuple[str, float | None]
# Gives no job up, however many of its shards are bad.
LENIENT = RetryPolicy(max_quarantined_share=1.0)


class FakeClock:
    """Seconds that only grow when told to."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def report_of(order: AttemptOrder, outcome: str, wall_s: float) -> AttemptReport:
    """A worker's answer; an outcome with `!` ends the job."""
    committed = outcome == "committed"
    return AttemptReport(
        order.attempt,
        order.shard,
        outcome.rstrip("!"),  # type: ignore[arg-type]
        cause="" if committed else f"scripted {outcome}",
        labels=10 * committed,
        positives=3 * committed,
        cost=Cost(wall_s=wall_s, cpu_s=wall_s / 2),
        ends_job=outcome.endswith("!"),
    )


def commit_by(shard: int, attempt: str, samples: int = 10) -> Commit:
    """The record of a commit of three positives in six seconds."""
    host = Host(name="h", cpu="c", cores=1, memory_bytes=1)
    return Commit(
        shard=shard, attempt=attempt, spec_hash="0" * 64, scenes=1, samples=samples, positives=3,
        redraws={}, object=FileEntry.of("a.zip", b""),
        cost=Cost(wall_s=6.0, cpu_s=3.0), host=host, code_digest="0" * 64, created="",
    )  # fmt: skip


@dataclass
class SimulatedExecutor:
    """`slots` workers that take orders in turn. `fate(order, n)` scripts the shard's n-th attempt.

    With `twice`, every report comes two times, as after a lost acknowledgement.
    """

    clock: FakeClock
    fate: Callable[[AttemptOrder, int], Fate]
    slots: int = 4
    twice: bool = False
    deaf: bool = False  # kills are never confirmed
    notes: bool = True  # whether it can tell what has begun
    most_in_flight: int = 0
    orders: list[AttemptOrder] = field(default_factory=list)
    keep_orders: bool = False
    _tries: Counter[int] = field(default_factory=Counter[int])
    _queue: list[AttemptOrder] = field(default_factory=list)
    _running: dict[str, AttemptOrder] = field(default_factory=dict)
    _ends: list[tuple[float, str, str, float]] = field(default_factory=list)
    _ready: list[AttemptReport] = field(default_factory=list)

    def submit(self, order: AttemptOrder) -> None:
        self._queue.append(order)
        if self.keep_orders:
            self.orders.append(order)
        self._start()
        self.most_in_flight = max(self.most_in_flight, self.in_flight)

    def _start(self) -> None:
        while self._queue and len(self._running) < self.slots:
            order = self._queue.pop(0)
            self._tries[order.shard] += 1
            outcome, wall_s = self.fate(order, self._tries[order.shard])
            self._running[order.attempt] = order
            if wall_s is not None:
                heapq.heappush(self._ends, (self.clock.now_s + wall_s, order.attempt, outcome, wall_s))

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        limit_s = self.clock.now_s + timeout_s
        ready, self._ready = self._ready, []
        while not ready and self._ends and self._ends[0][0] <= limit_s:
            end_s, attempt, outcome, wall_s = heapq.heappop(self._ends)
            self.clock.now_s = max(self.clock.now_s, end_s)
            order = self._running.pop(attempt, None)
            if order is not None:  # else it was killed
                if outcome == "committed":
                    del self._tries[order.shard]  # a million shards must not be remembered
                ready += [report_of(order, outcome, wall_s)] * (2 if self.twice else 1)
            self._start()
        if not ready:
            self.clock.now_s = max(limit_s, self.clock.now_s + 1e-3)
        return ready

    @property
    def in_flight(self) -> int:
        return len(self._queue) + len(self._running)

    def has_begun(self, attempt: str) -> bool:
        return self.notes and attempt in self._running

    def kill(self, attempt: str) -> None:
        order = self._running.pop(attempt, None)
        for waiting in [o for o in self._queue if o.attempt == attempt]:
            self._queue.remove(waiting)
            order = waiting
        if order is not None and not self.deaf:
            self._ready.append(replace(report_of(order, "cancelled", 0.0), cause="ended by force"))
        self._start()


@dataclass
class PaperRecorder:
    """A recorder that only counts, and remember the commits that a test gives them."""

    keep_entries: bool = True
    entries: list[LedgerEntry] = field(default_factory=list)
    given_up: dict[int, ShardFailures] = field(default_factory=dict)
    commits: dict[int, Commit] = field(default_factory=dict)
    closed: Counter[str] = field(default_factory=Counter)

    def close(self, entry: LedgerEntry, commit: Commit | None = None) -> None:
        self.closed[entry.outcome] += 1
        if self.keep_entries:
            self.entries.append(entry)

    def quarantine(self, shard: int, trouble: ShardFailures) -> None:
        self.given_up[shard] = trouble

    def commit_of(self, shard: int) -> Commit | None:
        return self.commits.get(shard)

    def missing(self) -> ShardRanges:
        return ShardRanges.of(range(10**9)).without(ShardRanges.of(self.commits))


@dataclass
class Heard:
    """Events as they came."""

    actions: list[tuple[int, str, str]] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    on_tick: Callable[[JobTotals], None] = lambda totals: None

    def ended(self, report: AttemptReport, action: str) -> None:
        self.actions.append((report.shard, report.outcome, action))

    def tick(self, totals: JobTotals) -> None:
        self.on_tick(totals)

    def stopping(self, reason: str) -> None:
        self.reasons.append(reason)
