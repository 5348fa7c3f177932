"""Publishes a running job's status, and polls for requests to stop it that come from elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from datagen.cluster.driver import Events
from datagen.cluster.job_totals import JobTotals
from datagen.cluster.progress import left_of
from datagen.cluster.stop_request import StopRequest
from datagen.cluster.task import AttemptReport
from datagen.schemas.progress import Pace

StopMode = Literal["drain", "force"]


@dataclass(frozen=True)
class JobStatus:
    """The status of a job at one moment."""

    totals: JobTotals
    labels_per_s: float
    left_s: float | None  # None while the rate is not known
    stopping: str  # why nothing new is begun; "" while it is


class StatusBoard(Protocol):
    """Where a job publishes its status, and where others leave requests to stop it."""

    def publish(self, status: JobStatus) -> None: ...

    def stop_requested(self) -> StopMode | None:
        """How this job was asked to stop; None if it was not."""
        ...


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
    clock: Callable[[], float] = time.monotonic
    beat_s: float = 10.0
    look_s: float = 3.0
    _heard: set[StopMode] = field(default_factory=set[StopMode])
    _reason: str = ""

    def __post_init__(self) -> None:
        self._pace = Pace(self.clock)
        self._next_beat_s = self._next_look_s = self.clock()

    def ended(self, report: AttemptReport, action: str) -> None:
        """Each attempt is in the ledger; nothing is added here."""
        self.shown.ended(report, action)

    def stopping(self, reason: str) -> None:
        """Publish at the next tick that the job is stopping."""
        self.shown.stopping(reason)
        self._reason, self._next_beat_s = reason, self.clock()

    def tick(self, totals: JobTotals) -> None:
        """Poll and publish when it is time."""
        self.shown.tick(totals)
        self._pace.see(totals.labels)
        now_s = self.clock()
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + self.look_s
            self._handle(self.board.stop_requested())
        if now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self.beat_s
            left_s = left_of(totals, self._pace, self.labels_per_shard)
            self.board.publish(JobStatus(totals, self._pace.per_s(), left_s, self._reason))

    def _handle(self, mode: StopMode | None) -> None:
        if mode is None or mode in self._heard:
            return
        self._heard.add(mode)
        # A signal may have asked before: together they ask once.
        while not (self.stop.force if mode == "force" else self.stop.drain):
            self.stop.ask()
