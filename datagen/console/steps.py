"""How far a long look or change is: a bar on a terminal, JSON lines anywhere else."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from cluster.progress import clock_text

_EVERY_S = 10.0
Step = Callable[[], None]
Seen = Callable[[int, int], None]


@contextmanager
def counting(
    what: str, as_json: bool | None = None, clock: Callable[[], float] = time.monotonic
) -> Generator[Seen]:
    """Give a function to call with (done, of how many); standard error shows how far that is.

    `what` names what is counted, in the plural. `as_json` None chooses: a bar on a terminal, JSON lines
    otherwise.
    """
    if not sys.stderr.isatty() if as_json is None else as_json:
        yield _lines(what, clock)
        return
    columns = (TextColumn(f"[bold]{what}"), BarColumn(bar_width=None), MofNCompleteColumn(), _Pace())
    with Progress(*columns, console=Console(stderr=True), expand=True) as bar:
        row = bar.add_task(what, total=None)
        yield lambda done, of: bar.update(row, completed=done, total=of)


@contextmanager
def steps(
    what: str, total: int, as_json: bool | None = None, clock: Callable[[], float] = time.monotonic
) -> Generator[Step]:
    """Give a function to call after each of `total` steps, shown as by `counting`."""
    with counting(what, as_json, clock) as seen:
        done = 0

        def step() -> None:
            nonlocal done
            done += 1
            seen(done, total)

        yield step


def _lines(what: str, clock: Callable[[], float]) -> Seen:
    started_s = clock()
    next_s = started_s + _EVERY_S

    def seen(done: int, of: int) -> None:
        nonlocal next_s
        now_s = clock()
        if now_s < next_s:
            return
        next_s = now_s + _EVERY_S
        rate = done / (now_s - started_s)
        left_s = round(max(of - done, 0) / rate) if rate > 0 else None
        line = {"event": "progress", "what": what, "done": done, "of": of}
        sys.stderr.write(json.dumps({**line, "per_s": round(rate, 1), "left_s": left_s}) + "\n")
        sys.stderr.flush()

    return seen


class _Pace(ProgressColumn):
    """Steps a second and the time left."""

    max_refresh = 0.2

    def render(self, task: Task) -> Text:
        rate = f"{task.speed:,.0f}/s  " if task.speed else ""
        return Text(f"{rate}{clock_text(task.time_remaining)} left", no_wrap=True)
