"""Progress of a job: its driver's events on the terminal, and as a status that other processes read."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from datagen.cluster.driver import Events
from datagen.cluster.job_totals import JobTotals
from datagen.cluster.run_forecast import RunForecast, shown_range
from datagen.cluster.shard_costs import Interval
from datagen.cluster.stop_request import StopRequest
from datagen.cluster.task import AttemptReport
from datagen.display.progress import Pace, Progress, clock_text, whole

StopMode = Literal["drain", "force"]


@dataclass(frozen=True)
class JobStatus:
    """The status of a job at one moment."""

    totals: JobTotals
    labels_per_s: float
    left_s: float | None  # None while the rate is not known
    left_80_s: Interval | None  # None while too few shards are made
    stopping: str  # why no new shard is started; "" otherwise


class StatusBoard(Protocol):
    """Publishes the status of a job, and holds requests of other processes to stop it."""

    def publish(self, status: JobStatus) -> None: ...
    def stop_requested(self) -> StopMode | None: ...


@dataclass(frozen=True)
class TimeLeft:
    """The time until the last shard, as an interval from the costs of the shards made so far."""

    forecast: RunForecast
    workers: Callable[[], int]  # the number that can work at the same time now

    def of(self, totals: JobTotals, workers: int) -> Interval | None:
        """The interval for this number of workers; None while too few shards are made."""
        return self.forecast.left(totals.shards - totals.finished, workers)


class JobProgress:
    """Events that show shards done, rate, time left, retries, quarantined shards and cost so far.

    `done_before` counts the shards of earlier jobs. With `left`, the time left is an interval.
    """

    def __init__(
        self, shown: Progress, labels_per_shard: int, done_before: int = 0, left: TimeLeft | None = None
    ) -> None:
        self._shown, self._pace, self._labels_per_shard = shown, Pace(shown.clock), labels_per_shard
        self._done_before, self._note, self._left = done_before, "", left

    def ended(self, report: AttemptReport, action: str) -> None:
        if action in ("retry", "quarantine", "abort"):
            values = {name: getattr(report, name) for name in ("shard", "attempt", "cause")}
            text = f"shard {report.shard} {report.outcome}: {report.cause} ({action})"
            style = "yellow" if action == "retry" else "red"
            self._shown.say("attempt_" + report.outcome, {**values, "action": action}, text, style)

    def tick(self, totals: JobTotals) -> None:
        self._pace.see(totals.labels)
        done, of = self._done_before + totals.finished, self._done_before + totals.shards
        # The figures may be shown after the executor is closed, so the workers are counted here.
        workers = self._left.workers() if self._left else 0
        self._shown.update("shards", done, of, lambda: self._figures(totals, workers))

    def stopping(self, reason: str) -> None:
        self._note = "  stopping"
        text = f"{reason}: waiting for running attempts; Ctrl-C again stops at once"
        self._shown.say("stopping", {"reason": reason}, text, "yellow")

    def _figures(self, totals: JobTotals, workers: int) -> tuple[str, dict[str, object]]:
        rate, left_s = self._pace.per_s(), left_of(totals, self._pace, self._labels_per_shard)
        interval = self._left.of(totals, workers) if self._left else None
        left = clock_text(left_s) if interval is None else shown_range(interval)
        cpu_s = totals.useful_cpu_s + totals.wasted_cpu_s
        # Rare figures are omitted when 0, to fit 80 columns.
        quarantined = f"  {totals.quarantined} quarantined" if totals.quarantined else ""
        text = (
            f"{rate:,.0f} labels/s  {left} left  "
            f"{totals.retries} retries{quarantined}  {cpu_s / 3600:.2f} core-h{self._note}"
        )
        return text, {
            "shards_done": self._done_before + totals.finished,
            "shards": self._done_before + totals.shards,
            "labels": totals.labels,
            "labels_per_s": round(rate, 1),
            "left_s": whole(left_s),
            "left_80_s": interval and [whole(interval.low), whole(interval.high)],
            "in_flight": totals.in_flight,
            "retries": totals.retries,
            "quarantined": totals.quarantined,
            "cpu_s": round(cpu_s, 1),
            "wasted_wall_s": round(totals.wasted_wall_s, 1),
        }


def left_of(totals: JobTotals, pace: Pace, labels_per_shard: int) -> float | None:
    """Seconds until the last shard at the current rate; None while unknown."""
    return pace.left_s((totals.shards - totals.finished) * labels_per_shard)


@dataclass
class JobMonitor:
    """A driver's events: publishes the status every `beat_s` seconds, polls for requests every `look_s`.

    Each event goes to `shown` first. `clock` gives seconds and only grows. A request is passed on to
    `stop`, each mode once.
    """

    board: StatusBoard
    stop: StopRequest
    labels_per_shard: int
    shown: Events
    left: TimeLeft | None = None
    clock: Callable[[], float] = time.monotonic
    beat_s: float = 10.0
    look_s: float = 3.0
    _handled: set[StopMode] = field(default_factory=set[StopMode])
    _reason: str = ""

    def __post_init__(self) -> None:
        self._pace = Pace(self.clock)
        self._next_beat_s = self._next_look_s = self.clock()

    def ended(self, report: AttemptReport, action: str) -> None:
        """Add the cost of a committed shard to the forecast."""
        if self.left is not None and report.outcome == "committed" and report.cost is not None:
            self.left.forecast.add(report.cost, report.host)
        self.shown.ended(report, action)

    def stopping(self, reason: str) -> None:
        """Publish at the next tick that the job is stopping."""
        self.shown.stopping(reason)
        self._reason, self._next_beat_s = reason, self.clock()

    def tick(self, totals: JobTotals) -> None:
        self.shown.tick(totals)
        self._pace.see(totals.labels)
        now_s = self.clock()
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + self.look_s
            self._handle(self.board.stop_requested())
        if now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self.beat_s
            left_s = left_of(totals, self._pace, self.labels_per_shard)
            interval = self.left.of(totals, self.left.workers()) if self.left else None
            self.board.publish(JobStatus(totals, self._pace.per_s(), left_s, interval, self._reason))

    def _handle(self, mode: StopMode | None) -> None:
        if mode is None or mode in self._handled:
            return
        self._handled.add(mode)
        # A signal may have made the same request before: it counts once.
        while not (self.stop.force if mode == "force" else self.stop.drain):
            self.stop.ask()
