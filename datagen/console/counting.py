"""How a long look at a run goes on: a bar on a terminal, JSON lines anywhere else."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from cluster.progress import clock_text

_EVERY_S = 10.0

Seen = Callable[[int, int], None]


@contextmanager
def counting(what: str, unit: str = "shards", as_json: bool | None = None) -> Generator[Seen]:
    """Call what it gives with (done, total); it shows rate and time left on standard error."""
    if not sys.stderr.isatty() if as_json is None else as_json:
        yield _lines(what, unit)
        return
    columns = (
        TextColumn(f"[bold]{what}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn(unit),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    began_s = time.monotonic()
    with Progress(*columns, console=Console(stderr=True), expand=True, transient=True) as bar:
        row = bar.add_task(what, total=None, rate="")

        def seen(done: int, total: int) -> None:
            elapsed_s = time.monotonic() - began_s
            rate = f"{done / elapsed_s:,.0f}/s" if elapsed_s > 0 else ""
            bar.update(row, completed=done, total=total, rate=rate)

        yield seen


def _lines(what: str, unit: str) -> Seen:
    began_s = last_s = time.monotonic()

    def seen(done: int, total: int) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        if now_s - last_s < _EVERY_S:
            return
        last_s = now_s
        rate = done / (now_s - began_s)
        line = {
            "event": "progress",
            "what": what,
            "done": done,
            "of": total,
            "unit": unit,
            "per_s": round(rate, 2),
            "left": clock_text((total - done) / rate if rate > 0 else None),
        }
        sys.stderr.write(json.dumps(line) + "\n")
        sys.stderr.flush()

    return seen
