"""A simulated cluster on which everything goes wrong, and which counts for itself what was done."""

from __future__ import annotations

import heapq
import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptReport, JobSummary, JobTotals, StopRequest
from datagen.cluster.shard_policy import RetryPolicy, ShardFailures
from datagen.schemas.run_records import Commit
from datagen.schemas.shard_ranges import ShardRanges
from tests.cluster.simulated import FakeClock, Heard, PaperRecorder, commit_by, report_of

# Share of attempts, and how they end. What is silent never ends by itself.
TROUBLES = ((0.004, "crashed"), (0.003, "failed"), (0.001, "out_of_memory"), (0.001, "silent"))
NODE_LIVES_S, NODE_GONE_S = 4000.0, 60.0
SLOW_NODES, SLOWER = 0.1, 8.0
ZOMBIES, DOUBLES = 0.3, 0.05


class BadCluster:
    """Nodes that get lost with all their attempts, slow ones, attempts that fail, reports that come twice.

    Some attempts of a lost node live on, and commit at once or some time later. `done` has one byte a
    shard: how often it was committed. `outcomes` and the sums count each attempt once, as the driver should.
    """

    def __init__(
        self, clock: FakeClock, shards: int, seed: int, nodes: int = 16, slots_a_node: int = 4
    ) -> None:
        self.clock, self.rng = clock, random.Random(seed)
        self.done = bytearray(shards)
        self.poisoned = set(self.rng.sample(range(shards), shards // 500))
        self.recorder = _Books(self)
        self.outcomes: Counter[str] = Counter()
        self.useful_s = self.wasted_s = 0.0
        self.failures: Counter[tuple[int, str]] = Counter()  # by shard and budget, of open shards
        self._slots_a_node, self._alive = slots_a_node, [True] * nodes
        self._slow = {node for node in range(nodes) if self.rng.random() < SLOW_NODES}
        self._free = [node for node in range(nodes) for _ in range(slots_a_node)]
        self._queue: deque[AttemptOrder] = deque()
        self._running: dict[str, tuple[AttemptOrder, int]] = {}
        self._events: list[tuple[float, int, str, object]] = []
        self._numbered = 0
        self._ready: list[AttemptReport] = []
        for node in range(nodes):
            self._at(self.rng.expovariate(1 / NODE_LIVES_S), "loss", node)

    @property
    def slots(self) -> int:
        return max(1, sum(self._alive) * self._slots_a_node)

    def _at(self, in_s: float, kind: str, what: object) -> None:
        self._numbered += 1
        heapq.heappush(self._events, (self.clock.now_s + in_s, self._numbered, kind, what))

    def submit(self, order: AttemptOrder) -> None:
        self._queue.append(order)
        self._start()

    def _start(self) -> None:
        while self._queue and self._free:
            order, node = self._queue.popleft(), self._free.pop()
            self._running[order.attempt] = (order, node)
            wall_s = self.rng.uniform(5, 8) * (SLOWER if node in self._slow else 1)
            outcome, luck = "committed", self.rng.random()
            for share, word in TROUBLES:
                if luck < share:
                    outcome = word
                    break
                luck -= share
            if order.shard in self.poisoned:
                outcome = "crashed"
            if outcome != "silent":
                self._at(wall_s, "end", (order.attempt, outcome, wall_s))

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        limit_s = self.clock.now_s + timeout_s
        while not self._ready and self._events[0][0] <= limit_s:
            at_s, _, kind, what = heapq.heappop(self._events)
            self.clock.now_s = max(self.clock.now_s, at_s)
            getattr(self, f"_{kind}")(what)
            self._start()
        ready, self._ready = self._ready, []
        if not ready:
            self.clock.now_s = max(limit_s, self.clock.now_s + 1e-3)
        self._ready += [report for report in ready if self.rng.random() < DOUBLES]
        return ready

    def _end(self, what: tuple[str, str, float]) -> None:
        attempt, outcome, wall_s = what
        if attempt not in self._running:
            return  # its node was lost, or it was killed
        order, node = self._running.pop(attempt)
        self._free.append(node)
        if outcome == "committed":
            outcome = "committed" if self._commit(order.shard) else "superseded"
        elif self.done[order.shard] and outcome != "failed":  # by a zombie: the driver finds its commit
            outcome = "superseded"
        self._count(order.shard, outcome, wall_s)
        self._ready.append(report_of(order, outcome, wall_s))

    def _commit(self, shard: int) -> bool:
        if self.done[shard]:
            return False
        self.done[shard] += 1
        for budget in ("failures", "lost", "out_of_memory"):
            self.failures.pop((shard, budget), None)
        return True

    def _count(self, shard: int, outcome: str, wall_s: float) -> None:
        self.outcomes[outcome] += 1
        if outcome == "committed":
            self.useful_s += wall_s
            return
        self.wasted_s += wall_s
        if outcome not in ("superseded", "cancelled") and not self.done[shard]:
            budget = outcome if outcome in ("lost", "out_of_memory") else "failures"
            self.failures[shard, budget] += 1

    def _loss(self, node: int) -> None:
        self._alive[node] = False
        self._free = [free for free in self._free if free != node]
        for attempt, (order, at) in list(self._running.items()):
            if at != node:
                continue
            del self._running[attempt]
            zombie = self.rng.random() < ZOMBIES and order.shard not in self.poisoned
            if zombie and self.rng.random() < 0.5 and self._commit(order.shard):
                # It committed before its node went: the driver finds the record and counts its cost.
                self.recorder.commits[order.shard] = commit = commit_by(order.shard, order.attempt)
                self._count(order.shard, "committed", commit.cost.wall_s)
            elif self.done[order.shard]:
                self._count(order.shard, "superseded", 0.5)
            else:
                self._count(order.shard, "lost", 0.5)
                if zombie:
                    self._at(self.rng.uniform(1, 30), "zombie", order)
            self._ready.append(report_of(order, "lost", 0.5))
        self._at(NODE_GONE_S, "return", node)

    def _zombie(self, order: AttemptOrder) -> None:
        if order.shard not in self.recorder.given_up and self._commit(order.shard):
            self.recorder.commits[order.shard] = commit_by(order.shard, order.attempt)

    def _return(self, node: int) -> None:
        self._alive[node] = True
        self._free += [node] * self._slots_a_node
        self._at(self.rng.expovariate(1 / NODE_LIVES_S), "loss", node)

    def has_begun(self, attempt: str) -> bool:
        return attempt in self._running

    def kill(self, attempt: str) -> None:
        """The driver takes it for hung, unless another attempt has committed its shard."""
        order, node = self._running.pop(attempt)
        self._free.append(node)
        self._count(order.shard, "superseded" if self.done[order.shard] else "hung", 0.0)
        self._ready.append(replace(report_of(order, "cancelled", 0.0), cause="ended by force"))


class _Books(PaperRecorder):
    """A recorder that only counts; a quarantine must be deserved."""

    def __init__(self, cluster: BadCluster) -> None:
        super().__init__(keep_entries=False)
        self._cluster = cluster

    def quarantine(self, shard: int, trouble: ShardFailures) -> None:
        of = self._cluster.failures
        spent = (of[shard, "failures"] >= 3, of[shard, "lost"] >= 10, of[shard, "out_of_memory"] >= 2)
        assert any(spent) and not self._cluster.done[shard]
        assert len(trouble.attempts) == sum(of[shard, name] for name in ("failures", "lost", "out_of_memory"))
        assert shard not in self.given_up
        self.given_up[shard] = ShardFailures()

    def commit_of(self, shard: int) -> Commit | None:
        another = commit_by(shard, "another") if self._cluster.done[shard] else None
        return self.commits.get(shard, another)

    def missing(self) -> ShardRanges:
        return ShardRanges.of(np.flatnonzero(np.frombuffer(self._cluster.done, np.uint8) == 0))


class Silent(Heard):
    """A display that keeps nothing."""

    def ended(self, report: AttemptReport, action: str) -> None:
        return


def simulate(
    shards: int, seed: int, nodes: int = 16, on_tick: Callable[[JobTotals], None] = lambda totals: None
) -> tuple[JobSummary, BadCluster]:
    """Drive the shards to their end and check the result against the cluster's own count."""
    clock = FakeClock()
    cluster = BadCluster(clock, shards, seed, nodes)
    silent = Silent(on_tick=on_tick)
    summary = drive(
        range(shards), lambda o: o, cluster, cluster.recorder, RetryPolicy(), silent, StopRequest(), clock
    )
    # Every shard is done once or given up, and the totals are what the cluster counted.
    totals, given_up, done = summary.totals, cluster.recorder.given_up, np.frombuffer(cluster.done, np.uint8)
    assert summary.end == "complete" and summary.remaining == 0
    assert int(done.max()) == 1 and int(done.sum()) + len(given_up) == shards
    assert not any(done[shard] for shard in given_up)
    assert cluster.poisoned <= set(given_up) and totals.quarantined == len(given_up)
    assert totals.outcomes == cluster.outcomes == cluster.recorder.closed
    assert totals.committed == cluster.outcomes["committed"] and totals.labels == 10 * totals.committed
    assert totals.superseded == cluster.outcomes["superseded"]
    assert totals.committed + totals.superseded + totals.elsewhere == int(done.sum())
    for said, counted in ((totals.useful_wall_s, cluster.useful_s), (totals.wasted_wall_s, cluster.wasted_s)):
        assert abs(said - counted) <= 1e-9 * counted + 1e-6
    return summary, cluster
