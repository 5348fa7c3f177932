"""Progress of a command on standard error: a bar on a terminal, else lines of text; JSON lines with --json.

Used by `cluster` and `train`; needs neither Ray nor torch.
"""

from __future__ import annotations

import itertools
import json
import select
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from typing import Any, TextIO, cast

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bar
from rich.table import Column
from rich.text import Text

from datagen.schemas.errors import printable

_RATE_OVER_S, _LINE_EVERY_S, _DRAW_EVERY_S = 60.0, 10.0, 0.2
Clock = Callable[[], float]
Figures = Callable[[], tuple[str, dict[str, object]]]  # text for people, values for programs
Step = Callable[[], None]
Seen = Callable[[int, int], None]


class Pace:
    """Growth rate of totals that begin at 0, per second of `clock`, over the last minute."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._seen: deque[tuple[float, tuple[float, ...]]] = deque([(clock(), ())])
        self._totals: tuple[float, ...] = ()

    def see(self, *totals: float) -> None:
        now_s, self._totals = self._clock(), totals
        if now_s - self._seen[-1][0] >= 1.0:
            self._seen.append((now_s, totals))
        while len(self._seen) > 2 and now_s - self._seen[1][0] >= _RATE_OVER_S:
            self._seen.popleft()

    def per_s(self, which: int = 0) -> float:
        """Growth of one total per second; 0 while unknown, or where killed attempts have made it less."""
        then_s, before = self._seen[0]
        elapsed_s = self._clock() - then_s
        grown = self._totals[which] - (before[which] if before else 0) if self._totals else 0.0
        return max(0.0, grown / elapsed_s) if elapsed_s > 0 else 0.0

    def left_s(self, more: float, which: int = 0) -> float | None:
        """Seconds until one total has grown by `more`; None while its rate is unknown."""
        rate = self.per_s(which)
        return max(0.0, more) / rate if rate > 0 else None


class Progress:
    """Shows phases by name and, for countable ones, the progress with figures.

    Without a terminal, a phase without numbers is one line, and the others print a line every ten seconds.
    The last state is printed only after such a line, so that quick work prints nothing.
    """

    def __init__(
        self, as_json: bool = False, clock: Clock = time.monotonic, console: Console | None = None
    ) -> None:
        self._json, self.clock = as_json, clock
        self._console = console or Console(
            file=cast(TextIO, LossyStream(sys.stderr, waits=False)), force_terminal=sys.stderr.isatty()
        )
        # A notebook shows a bar through ipywidgets; without them it gets lines of text.
        notebook = self._console.is_jupyter and find_spec("ipywidgets") is not None
        self._live = (self._console.is_interactive or notebook) and not as_json
        self._every_s = _DRAW_EVERY_S if self._live else _LINE_EVERY_S
        self._next_s = clock() + (0.0 if self._live else self._every_s)
        self._state: tuple[str, int, int, Figures] | None = None  # not shown yet
        self._is_shown = self._live
        self._row: TaskID | None = None
        self._bar = Bar(
            TextColumn("{task.description}", style="bold", markup=False),
            BarColumn(bar_width=None),
            # On a narrow terminal the bar shrinks, not the figures.
            TextColumn("{task.fields[text]}", markup=False, table_column=Column(no_wrap=True)),
            console=self._console,
            expand=True,
        )

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def phase(self, name: str) -> None:
        """Show the name of a phase without numbers."""
        self._end_row()
        if self._live:
            self._draw(name)
        else:
            self.say("phase", {"phase": name}, name)

    def update(self, what: str, done: int, of: int, figures: Figures) -> None:
        """Show that `done` of `of` (0: unknown) are done; `what` is their plural name. Cheap to call."""
        self._state = what, done, of, figures
        if (now_s := self.clock()) >= self._next_s:
            self._next_s, self._is_shown = now_s + self._every_s, True
            self._show()

    def counter(self, what: str) -> Seen:
        """A function `seen(done, of)` that shows the progress of `what` with rate and time left."""
        pace = Pace(self.clock)

        def seen(done: int, of: int) -> None:
            def figures() -> tuple[str, dict[str, object]]:
                rate, left_s = pace.per_s(), pace.left_s(of - done)
                values = {"what": what, "done": done, "of": of, "per_s": round(rate, 1)}
                return f"{rate:,.0f}/s  {clock_text(left_s)} left", {**values, "left_s": whole(left_s)}

            pace.see(done)
            self.update(what, done, of, figures)

        return seen

    def say(self, event: str, values: Mapping[str, object], text: str, style: str = "") -> None:
        """Print a line above the bar: `text`, or as JSON the event with its values."""
        self._is_shown = True
        if self._live:
            self._console.print(Text(printable(text), style=style), soft_wrap=True)
        else:
            line = json.dumps({"event": event, **values}) if self._json else printable(text)
            print(line, file=self._console.file, flush=True)

    def close(self) -> None:
        self._end_row()
        if self._live:
            self._bar.stop()

    def _end_row(self) -> None:
        if self._is_shown:
            self._show()
        if self._row is not None and self._bar.tasks[-1].total is None:
            self._bar.remove_task(self._row)
        self._row = None

    def _show(self) -> None:
        if self._state is None:
            return
        (what, done, of, figures), self._state = self._state, None
        text, values = figures()
        if self._live:
            self._draw(what, done, of, f"{done}/{of or '?'}  {text}")
        else:
            self.say("progress", values, f"{what} {done}/{of}  {text}")

    def _draw(self, name: str, done: int = 0, of: int = 0, text: str = "") -> None:
        if self._row is None:
            self._row = self._bar.add_task(name, total=None, text="")
        self._bar.update(self._row, description=name, completed=done, total=of or None, text=text)
        self._bar.start()


@contextmanager
def counting(what: str, as_json: bool = False, clock: Clock = time.monotonic, of: int = 0) -> Generator[Seen]:
    """Give a function `seen(done, of)` that shows the progress with rate and time left."""
    with Progress(as_json, clock) as progress:
        seen = progress.counter(what)
        seen(0, of)  # a terminal shows it from the start
        yield seen


@contextmanager
def steps(what: str, total: int, as_json: bool = False, clock: Clock = time.monotonic) -> Generator[Step]:
    """Give a function to call after each of `total` steps, shown as by `counting`."""
    with counting(what, as_json, clock, total) as seen:
        done = itertools.count(1)
        yield lambda: seen(next(done), total)


def whole(seconds: float | None) -> int | None:
    """Whole seconds, for JSON."""
    return None if seconds is None else round(seconds)


def clock_text(seconds: float | None) -> str:
    """`h:mm:ss`, or dashes when not known."""
    if (left_s := whole(seconds)) is None:
        return "-:--:--"
    return f"{left_s // 3600}:{left_s // 60 % 60:02d}:{left_s % 60:02d}"


class LossyStream:
    """A text stream that drops text for a closed pipe, a full disk or a lost terminal.

    With `waits` false it also drops text for a reader that does not keep up, where a write would block.
    """

    def __init__(self, stream: TextIO, waits: bool = True) -> None:
        self._stream, self._poll = stream, None if waits else _poll_of(stream)

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError):  # ValueError: the stream is closed
            if self._poll is None or self._poll.poll(0):
                self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _poll_of(stream: TextIO) -> select.poll | None:
    """Whether the stream can be written now; None for one without a descriptor, as of a notebook."""
    try:
        number = stream.fileno()
    except (OSError, ValueError, AttributeError):
        return None
    poll = select.poll()
    poll.register(number, select.POLLOUT)
    return poll
