"""Progress over a known number of equal steps: a bar on a terminal, JSON lines anywhere else."""

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


@contextmanager
def steps(
    what: str, total: int, as_json: bool | None = None, clock: Callable[[], float] = time.monotonic
) -> Generator[Step]:
    """Give a function to call after each of `total` steps; standard error shows how far they are.

    `what` names them in the plural. `as_json` None chooses: a bar on a terminal, JSON lines otherwise.
    """
    if not sys.stderr.isatty() if as_json is None else as_json:
        yield _lines(what, total, clock)
        return
    columns = (TextColumn(f"[bold]{what}"), BarColumn(bar_width=None), MofNCompleteColumn(), _Pace())
    with Progress(*columns, console=Console(stderr=True), expand=True) as bar:
        row = bar.add_task(what, total=total)
        yield lambda: bar.advance(row)


def _lines(what: str, total: int, clock: Callable[[], float]) -> Step:
    done, started_s = 0, clock()
    next_s = started_s + _EVERY_S

    def step() -> None:
        nonlocal done, next_s
        done += 1
        now_s = clock()
        if now_s < next_s:
            return
        next_s = now_s + _EVERY_S
        rate = done / (now_s - started_s)
        line = {"event": "progress", "what": what, "done": done, "of": total}
        left_s = round(max(total - done, 0) / rate)
        sys.stderr.write(json.dumps({**line, "per_s": round(rate, 1), "left_s": left_s}) + "\n")
        sys.stderr.flush()

    return step


class _Pace(ProgressColumn):
    """Steps a second and the time left."""

    max_refresh = 0.2

    def render(self, task: Task) -> Text:
        rate = f"{task.speed:,.0f}/s  " if task.speed else ""
        return Text(f"{rate}{clock_text(task.time_remaining)} left", no_wrap=True)
