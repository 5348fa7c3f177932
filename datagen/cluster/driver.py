"""The driver: keeps a window of attempts in flight and decides on retries and quarantine.

    while shards are open:
        fill the window: due retries first, then new shards
        wait briefly for reports, and handle each: ledger, then done, retry or quarantine
        check attempts that are silent beyond their deadline
        check the commits of other drivers, after one superseded an attempt
        handle a stop request

Only the driver retries: executors never repeat an attempt by themselves.
"""

from __future__ import annotations

import heapq
import random
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from datagen.cluster.protocol import (
    AttemptOrder,
    AttemptReport,
    End,
    Executor,
    JobSummary,
    JobTotals,
    StopRequest,
)
from datagen.cluster.shard_policy import (
    Durations,
    OpenShards,
    RetryPolicy,
    ShardFailures,
    at_once,
    deadline_s,
    decide,
    ends_early,
    nothing_runs,
    too_many_quarantined,
    window,
)
from datagen.schemas.run_records import Commit, LedgerEntry, Outcome
from datagen.schemas.shard_ranges import ShardRanges

T = TypeVar("T")
# Upper bound of one wait, so that a stop request is handled soon.
_POLL_S = 0.25


class Recorder(Protocol):
    """Records of the ends of attempts and shards. `missing` are neither committed nor quarantined now."""

    def close(self, entry: LedgerEntry, commit: Commit | None) -> None: ...
    def quarantine(self, shard: int, trouble: ShardFailures) -> None: ...
    def commit_of(self, shard: int) -> Commit | None: ...
    def missing(self) -> ShardRanges: ...


class Events(Protocol):
    """Events for a progress display.

    `ended`: an attempt was recorded; `action` is the policy's decision. `tick` is called often; the totals
    are the driver's own and change. `stopping`: no new shard is started from now on.
    """

    def ended(self, report: AttemptReport, action: str) -> None: ...
    def tick(self, totals: JobTotals) -> None: ...
    def stopping(self, reason: str) -> None: ...


@dataclass
class _Flight:
    order: AttemptOrder
    number: int  # counts the attempts of this driver
    submitted_s: float
    check_s: float  # when to check it next
    alone: bool  # no other attempt was in flight at the same time
    begun: bool = False
    verdict: tuple[Outcome, str] | None = None  # set when the driver ended it


def drive(
    shards: Sequence[int],
    make_task: Callable[[AttemptOrder], T],
    executor: Executor[T],
    recorder: Recorder,
    policy: RetryPolicy,
    events: Events,
    stop: StopRequest,
    clock: Callable[[], float] = time.monotonic,
) -> JobSummary:
    """Run every shard until it is committed or quarantined.

    `clock` is monotonic, in seconds. Raises InputError when records cannot be written; on any exception the
    attempts in flight are killed first.
    """
    driver = _Driver(shards, make_task, executor, recorder, policy, events, stop, clock)
    try:
        return driver.run()
    finally:
        driver.kill_all("the driver ended")


@dataclass
class _Driver(Generic[T]):
    _shards: Sequence[int]
    _make_task: Callable[[AttemptOrder], T]
    _executor: Executor[T]
    _recorder: Recorder
    _policy: RetryPolicy
    _events: Events
    _stop: StopRequest
    _clock: Callable[[], float]

    def __post_init__(self) -> None:
        self._totals = JobTotals(len(self._shards))
        self._flights: dict[str, _Flight] = {}
        self._troubled: dict[int, ShardFailures] = {}
        self._due: list[tuple[float, int]] = []  # heap of (time, shard) that wait for a retry
        self._durations = Durations()
        self._numbered = 0
        self._lost_in_a_row = 0
        # Random: two drivers of one run must never give two attempts the same name.
        self._name = secrets.token_hex(4)
        self._open = OpenShards(self._shards, random.Random(self._name))
        # The number of the first attempt after this driver last moved to other shards.
        self._here_since = 1
        self._look_s = float("inf")  # when to check other drivers; never before one superseded an attempt
        self._looked_s = float("-inf")
        self._next_check_s = float("inf")
        self._end: End | None = None  # set once no new shard is started
        self._cause = ""
        self._drain_until_s = float("inf")

    def run(self) -> JobSummary:
        start_s = self._clock()
        while True:
            self._handle_stop()
            if self._end is None:
                self._fill()
            if not self._flights and (self._end is not None or not self._due):
                break
            for report in self._executor.wait(self._patience_s()):
                self._settle(report)
            self._check_silent()
            if self._clock() >= self._look_s:
                self._look_for_others()
            self._totals.in_flight = len(self._flights)
            self._events.tick(self._totals)
        failed = too_many_quarantined(self._policy, self._totals.quarantined, self._totals.shards)
        end = self._end
        if end is None or (end == "interrupted" and self._totals.finished == self._totals.shards):
            end = "failed" if failed else "complete"  # after the last shard, a stop request has no effect
        return JobSummary(end, self._cause, self._totals, self._clock() - start_s)

    # Begin ---------------------------------------------------------------------------------

    def _fill(self) -> None:
        room = at_once(self._lost_in_a_row, self._width()) - len(self._flights)
        while room > 0 and (shard := self._next_shard()) is not None:
            self._submit(shard)
            room -= 1

    def _next_shard(self) -> int | None:
        now_s = self._clock()
        while self._due and self._due[0][0] <= now_s:
            _, shard = heapq.heappop(self._due)
            flying = (flight.order.shard for flight in self._flights.values())
            if not (self._is_suspect(shard) and any(map(self._is_suspect, flying))):
                return shard
            # Attempts that were lost together may be lost together again because of one of them.
            heapq.heappush(self._due, (now_s + _POLL_S, shard))
        if len(self._due) >= self._policy.max_waiting:
            return None
        return self._open.next()

    def _is_suspect(self, shard: int) -> bool:
        """Whether the shard may crash its machine: then no other suspect runs at the same time."""
        return shard in self._troubled and self._troubled[shard].lost >= 2

    def _submit(self, shard: int) -> None:
        trouble = self._troubled.get(shard, ShardFailures())
        self._numbered += 1
        order = AttemptOrder(
            shard=shard,
            attempt=f"{shard:06d}-{self._name}-{self._numbered:06d}",
            deadline_s=deadline_s(self._policy, self._durations, trouble),
            may_be_done=bool(trouble.attempts or self._totals.superseded),
        )
        now_s = self._clock()
        check_s = now_s + order.deadline_s + self._policy.grace_s
        if len(self._flights) == 1:  # none of several is alone
            next(iter(self._flights.values())).alone = False
        self._flights[order.attempt] = _Flight(order, self._numbered, now_s, check_s, not self._flights)
        self._next_check_s = min(self._next_check_s, check_s)
        self._totals.retries += bool(trouble.attempts)
        self._executor.submit(self._make_task(order))

    def _patience_s(self) -> float:
        wake_s = min(self._next_check_s, self._due[0][0] if self._due else float("inf"))
        return min(_POLL_S, max(0.0, wake_s - self._clock()))

    # End -----------------------------------------------------------------------------------

    def _settle(self, report: AttemptReport) -> None:
        flight = self._flights.pop(report.attempt, None)
        if flight is None:
            return  # handled before: a second report, or one after the driver gave up waiting
        if report.outcome == "cancelled" and flight.verdict is not None:
            outcome, cause = flight.verdict
            report = replace(report, outcome=outcome, cause=cause)
        elif report.outcome == "cancelled" and self._end is None and not self._stop.drain:
            # Not cancelled by this driver: it counts as lost, and the shard stays open.
            report = replace(report, outcome="lost", cause="cancelled by another process")
        if report.outcome not in ("committed", "superseded"):
            report = self._corrected_by_commit(report)
        shard = report.shard
        successes = self._totals.committed + self._totals.superseded
        decision = decide(
            self._policy, self._troubled.get(shard, ShardFailures()), report, successes, flight.alone
        )
        # The former have no worker's report, and an unfit machine is not used again.
        if report.outcome not in ("cancelled", "hung") and not report.is_unfit:
            self._lost_in_a_row = self._lost_in_a_row + 1 if report.outcome == "lost" else 0
        self._recorder.close(LedgerEntry.model_validate(report, from_attributes=True), report.commit)
        self._totals.count(report)
        if report.outcome == "committed" and report.cost is not None:
            self._durations.add(report.cost.wall_s)
        if report.outcome == "superseded":
            self._avoid_other_driver(flight)
        if decision.action == "done":
            self._troubled.pop(shard, None)
        elif decision.action == "retry":
            self._troubled[shard] = decision.trouble
            heapq.heappush(self._due, (self._clock() + decision.wait_s, shard))
        elif decision.action == "move":
            heapq.heappush(self._due, (self._clock(), shard))
        elif decision.action == "quarantine":
            self._troubled.pop(shard, None)
            self._recorder.quarantine(shard, decision.trouble)
            self._totals.quarantined += 1
            if ends_early(self._policy, self._totals.quarantined, self._totals.shards):
                self._begin_end("failed", f"{self._totals.quarantined} shards are quarantined")
        is_futile = nothing_runs(self._policy, self._lost_in_a_row, self._width())
        if decision.action == "abort" or (self._end is None and is_futile):
            again = "" if decision.action == "abort" else "every attempt is lost, the last by: "
            self._begin_end("aborted", again + report.cause)
            self.kill_all("the job cannot continue")
        self._events.ended(report, decision.action)

    def _width(self) -> int:
        return min(window(self._policy, self._executor.slots), self._totals.shards - self._totals.finished)

    def _corrected_by_commit(self, report: AttemptReport) -> AttemptReport:
        """The report, corrected by the commit record: a worker may die, or miss the response, after it."""
        commit = self._recorder.commit_of(report.shard)
        if commit is None:
            return report
        if commit.attempt != report.attempt:
            return report if report.outcome == "failed" else replace(report, outcome="superseded")
        return replace(
            report,
            outcome="committed",
            cause="",
            stack="",
            ends_job=False,
            labels=commit.samples,
            positives=commit.positives,
            cost=commit.cost,
            host=commit.host,
        )

    # Others --------------------------------------------------------------------------------

    def _avoid_other_driver(self, flight: _Flight) -> None:
        """Another driver was faster at a shard: move to other shards, and check its commits."""
        if flight.number >= self._here_since:
            self._open.go_elsewhere()
            self._here_since = self._numbered + 1
        self._look_s = min(self._look_s, self._looked_s + self._policy.look_s)

    def _look_for_others(self) -> None:
        start_s = self._clock()
        dropped = self._open.keep(self._recorder.missing()) if len(self._open) else 0
        self._totals.elsewhere += dropped
        self._looked_s = self._clock()
        took_s = self._looked_s - start_s
        if not dropped:
            self._look_s = float("inf")  # no other driver nearby: wait until the next superseded attempt
            return
        # Listing a large run takes time: at most a small share of the driver's.
        self._look_s = self._looked_s + max(self._policy.look_s, self._policy.look_factor * took_s)

    # Silence -------------------------------------------------------------------------------

    def _check_silent(self) -> None:
        now_s = self._clock()
        if now_s < self._next_check_s:
            return
        for flight in [f for f in self._flights.values() if f.check_s <= now_s]:
            order = flight.order
            if flight.verdict is not None:
                outcome, cause = flight.verdict
                self._settle(AttemptReport(order.attempt, order.shard, outcome, cause))
            elif flight.begun:
                cause = f"still running after its deadline of {order.deadline_s:g} s; ended by the driver"
                self._kill(flight, "hung", cause)
            elif self._executor.has_begun(order.attempt):
                # Its start is unknown, so its time counts from now.
                flight.begun, flight.check_s = True, now_s + order.deadline_s + self._policy.grace_s
            elif now_s - flight.submitted_s > self._policy.queue_deadlines * order.deadline_s:
                self._kill(flight, "lost", "no worker reported its start")
            else:
                flight.check_s = now_s + order.deadline_s + self._policy.grace_s
        self._next_check_s = min((f.check_s for f in self._flights.values()), default=float("inf"))

    def _kill(self, flight: _Flight, outcome: Outcome, cause: str) -> None:
        flight.verdict = (outcome, cause)
        flight.check_s = self._clock() + self._policy.kill_s
        self._next_check_s = min(self._next_check_s, flight.check_s)
        self._executor.kill(flight.order.attempt)

    # Stop ----------------------------------------------------------------------------------

    def _handle_stop(self) -> None:
        if self._stop.drain and self._end is None:
            self._begin_end("interrupted", "asked to stop")
        if self._stop.force or self._clock() >= self._drain_until_s:
            self.kill_all("the job was stopped")

    def _begin_end(self, end: End, cause: str) -> None:
        if self._end is None:
            self._end, self._cause = end, cause
            self._drain_until_s = self._clock() + self._policy.drain_s
            self._events.stopping(cause)

    def kill_all(self, cause: str) -> None:
        for flight in list(self._flights.values()):
            if flight.verdict is None:
                self._kill(flight, "cancelled", cause)
