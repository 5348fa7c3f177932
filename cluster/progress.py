"""How a job looks while it runs: a bar on a terminal, JSON lines anywhere else."""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.progress import Task as Bar
from rich.table import Column
from rich.text import Text

from cluster.tally import Tally
from cluster.task import AttemptReport
from schemas.errors import printable

_RATE_OVER_S = 60.0


class Pace:
    """Labels per second over the last minute and the time left, from the tally alone."""

    def __init__(self, labels_per_shard: int, clock: Callable[[], float]) -> None:
        self._labels_per_shard, self._clock = labels_per_shard, clock
        self._seen: deque[tuple[float, int]] = deque([(clock(), 0)])

    def see(self, tally: Tally) -> None:
        now_s = self._clock()
        if now_s - self._seen[-1][0] >= 1.0:
            self._seen.append((now_s, tally.labels))
        while len(self._seen) > 2 and now_s - self._seen[1][0] >= _RATE_OVER_S:
            self._seen.popleft()

    def labels_per_s(self, tally: Tally) -> float:
        """Labels committed per second lately; 0 before the first commit."""
        then_s, labels = self._seen[0]
        elapsed_s = self._clock() - then_s
        return (tally.labels - labels) / elapsed_s if elapsed_s > 0 else 0.0

    def left_s(self, tally: Tally) -> float | None:
        """Seconds until the last shard at this rate; None while the rate is unknown."""
        rate = self.labels_per_s(tally)
        shards = tally.shards - tally.finished
        return shards * self._labels_per_shard / rate if rate > 0 else None


class JsonLines:
    """One JSON object a line: `progress` at intervals, and each thing that went wrong."""

    def __init__(
        self,
        labels_per_shard: int,
        shards: int,
        done_before: int = 0,
        every_s: float = 10.0,
        out: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._out = out or sys.stderr
        self._every_s, self._clock, self._done_before = every_s, clock, done_before
        self._pace = Pace(labels_per_shard, clock)
        self._next_s = clock() + every_s
        self._tally = Tally(shards)

    def ended(self, report: AttemptReport, action: str) -> None:
        if action in ("retry", "quarantine", "abort"):
            self._line(
                "attempt_" + report.outcome,
                shard=report.shard,
                attempt=report.attempt,
                cause=report.cause,
                action=action,
            )

    def tick(self, tally: Tally) -> None:
        self._tally = tally
        self._pace.see(tally)
        if self._clock() >= self._next_s:
            self._next_s = self._clock() + self._every_s
            self._progress()

    def stopping(self, reason: str) -> None:
        self._line("stopping", reason=reason)

    def close(self) -> None:
        """Say the last state."""
        self._progress()

    def _progress(self) -> None:
        tally = self._tally
        left_s = self._pace.left_s(tally)
        self._line(
            "progress",
            shards_done=self._done_before + tally.finished,
            shards=self._done_before + tally.shards,
            labels=tally.labels,
            labels_per_s=round(self._pace.labels_per_s(tally), 1),
            left_s=None if left_s is None else round(left_s),
            in_flight=tally.in_flight,
            retries=tally.retries,
            quarantined=tally.quarantined,
            cpu_s=round(tally.useful_cpu_s + tally.wasted_cpu_s, 1),
            wasted_wall_s=round(tally.wasted_wall_s, 1),
        )

    def _line(self, event: str, **values: object) -> None:
        print(json.dumps({"event": event, **values}), file=self._out, flush=True)


class TerminalBar:
    """A bar with rate, time left, retries, quarantined shards and cost so far."""

    def __init__(
        self,
        labels_per_shard: int,
        shards: int,
        done_before: int = 0,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pace, self._clock = Pace(labels_per_shard, clock), clock
        self._done_before, self._tally, self._note = done_before, Tally(shards), ""
        self._bar = Progress(
            TextColumn("[bold]shards"),
            BarColumn(bar_width=None),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            _Numbers(self._numbers),
            console=console or Console(stderr=True),
            expand=True,
            transient=False,
        )
        self._row = self._bar.add_task("shards", total=done_before + shards, completed=done_before)
        self._next_s = 0.0
        self._bar.start()

    def ended(self, report: AttemptReport, action: str) -> None:
        if action in ("retry", "quarantine", "abort"):
            text = printable(f"shard {report.shard} {report.outcome}: {report.cause} ({action})")
            self._bar.console.print(Text(text, style="yellow" if action == "retry" else "red"))

    def tick(self, tally: Tally) -> None:
        self._tally = tally
        self._pace.see(tally)
        if self._clock() >= self._next_s:
            self._next_s = self._clock() + 0.2
            self._bar.update(self._row, completed=self._done_before + tally.finished)

    def stopping(self, reason: str) -> None:
        self._note = " stopping"
        self._bar.console.print(
            Text(f"{reason}: waiting for what is in flight; Ctrl-C again ends it at once", style="yellow")
        )

    def close(self) -> None:
        """Draw the last state and give the terminal back."""
        self._bar.update(self._row, completed=self._done_before + self._tally.finished)
        self._bar.stop()

    def _numbers(self) -> str:
        tally, left_s = self._tally, self._pace.left_s(self._tally)
        cpu_h = (tally.useful_cpu_s + tally.wasted_cpu_s) / 3600
        # What is seldom there takes no room: a usual terminal has 80 columns.
        given_up = f"  {tally.quarantined} quarantined" if tally.quarantined else ""
        return (
            f"{self._pace.labels_per_s(tally):,.0f} labels/s  {clock_text(left_s)} left  "
            f"{tally.retries} retries{given_up}  {cpu_h:.2f} core-h{self._note}"
        )


class _Numbers(ProgressColumn):
    """The column of figures; Progress redraws it by itself."""

    max_refresh = 0.2

    def __init__(self, text: Callable[[], str]) -> None:
        # Where the terminal is narrow, the bar gives way and not the figures.
        super().__init__(table_column=Column(no_wrap=True))
        self._text = text

    def render(self, task: Bar) -> Text:
        return Text(self._text(), no_wrap=True, overflow="ellipsis")


def clock_text(seconds: float | None) -> str:
    """`h:mm:ss`, or dashes when not known."""
    if seconds is None:
        return "-:--:--"
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


@contextmanager
def progress(
    labels_per_shard: int, shards: int, done_before: int = 0, as_json: bool | None = None
) -> Generator[TerminalBar | JsonLines]:
    """The display that suits standard error, closed whatever ends the block.

    `shards` are those of this job and `done_before` those that earlier jobs had done. `as_json`
    None chooses: a bar on a terminal, JSON lines otherwise.
    """
    json_lines = not sys.stderr.isatty() if as_json is None else as_json
    sink = (
        JsonLines(labels_per_shard, shards, done_before)
        if json_lines
        else TerminalBar(labels_per_shard, shards, done_before)
    )
    try:
        yield sink
    finally:
        sink.close()
