"""A job that can be watched and stopped from elsewhere: it says how it is, and heeds what is asked of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from datagen.cluster.driver import Events
from datagen.cluster.job_totals import Tally
from datagen.cluster.progress import left_of
from datagen.cluster.stop_request import StopRequest
from datagen.cluster.task import AttemptReport
from datagen.schemas.progress import Pace

Wish = Literal["drain", "force"]


@dataclass(frozen=True)
class Standing:
    """How a job is at one moment."""

    tally: Tally
    labels_per_s: float
    left_s: float | None  # None while the rate is not known
    stopping: str  # why nothing new is begun; "" while it is


class Board(Protocol):
    """Where a job hangs out its state, and where others leave their wishes."""

    def tell(self, standing: Standing) -> None: ...

    def wish(self) -> Wish | None:
        """What somebody asked of this job, if anything."""
        ...


@dataclass
class Watch:
    """Events that keep a board: the state every `beat_s` seconds, a look for wishes every `look_s`.

    `shown` hears each event before.
    `clock` gives seconds and only grows. What the wish asks is asked of `stop`, once each.
    """

    board: Board
    stop: StopRequest
    labels_per_shard: int
    shown: Events
    clock: Callable[[], float] = time.monotonic
    beat_s: float = 10.0
    look_s: float = 3.0
    _heard: set[Wish] = field(default_factory=set[Wish])
    _reason: str = ""

    def __post_init__(self) -> None:
        self._pace = Pace(self.clock)
        self._next_beat_s = self._next_look_s = self.clock()

    def ended(self, report: AttemptReport, action: str) -> None:
        """Each attempt is in the ledger; nothing is added here."""
        self.shown.ended(report, action)

    def stopping(self, reason: str) -> None:
        """Say at the next tick that the job is stopping."""
        self.shown.stopping(reason)
        self._reason, self._next_beat_s = reason, self.clock()

    def tick(self, tally: Tally) -> None:
        """Look and tell when it is time."""
        self.shown.tick(tally)
        self._pace.see(tally.labels)
        now_s = self.clock()
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + self.look_s
            self._heed(self.board.wish())
        if now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self.beat_s
            left_s = left_of(tally, self._pace, self.labels_per_shard)
            self.board.tell(Standing(tally, self._pace.per_s(), left_s, self._reason))

    def _heed(self, wish: Wish | None) -> None:
        if wish is None or wish in self._heard:
            return
        self._heard.add(wish)
        # Somebody at the terminal may have asked before: that is not asking twice.
        while not (self.stop.force if wish == "force" else self.stop.drain):
            self.stop.ask()
