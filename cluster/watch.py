"""Publish a job's status and poll for stop requests."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from datagen.cluster.driver import Events
from datagen.cluster.progress import left_of
from datagen.cluster.stop import StopRequest
from datagen.cluster.tally import Tally
from datagen.cluster.task import AttemptReport
from datagen.schemas.progress import Pace

Wish = Literal["drain", "force"]


@dataclass(frozen=True)
class Standing:
    """Status of a job."""

    tally: Tally
    labels_per_s: float
    left_s: float | None  # None while the rate is unknown
    stopping: str  # why no new shard is started; "" while they are


class Board(Protocol):
    """Storage of a job's status and of stop requests."""

    def tell(self, standing: Standing) -> None: ...

    def wish(self) -> Wish | None:
        """The stop request for this job, if any."""
        ...


@dataclass
class Watch:
    """Events that publish the status every `beat_s` seconds and poll for stop requests every `look_s`.

    Each event is first passed to `shown`. `clock` is monotonic, in seconds. Each request is passed to `stop`
    once.
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
        """Attempts are recorded in the ledger only."""
        self.shown.ended(report, action)

    def stopping(self, reason: str) -> None:
        """Publish at the next tick that the job is stopping."""
        self.shown.stopping(reason)
        self._reason, self._next_beat_s = reason, self.clock()

    def tick(self, tally: Tally) -> None:
        """Poll and publish when it is time."""
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
        # A request at the terminal may have come before: the two count as one.
        while not (self.stop.force if wish == "force" else self.stop.drain):
            self.stop.ask()
