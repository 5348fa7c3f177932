"""How a training looks while it runs: a bar on a terminal, JSON lines anywhere else."""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.progress import Task as Bar
from rich.table import Column
from rich.text import Text

from train.training.watching import Step, Watcher

_RATE_OVER_S = 60.0
_LINE_EVERY_S = 10.0


class Pace:
    """Speed over the last minute: samples a second, seconds a step, and what of it went by for data."""

    def __init__(self) -> None:
        self._seen: deque[Step] = deque()
        self._step_s = self._wait_s = self._samples = 0.0

    def see(self, step: Step) -> None:
        self._seen.append(step)
        self._add(step, 1)
        while len(self._seen) > 1 and self._step_s - self._seen[0].step_s >= _RATE_OVER_S:
            self._add(self._seen.popleft(), -1)

    def _add(self, step: Step, sign: int) -> None:
        self._step_s += sign * step.step_s
        self._wait_s += sign * step.wait_s
        self._samples += sign * step.samples

    @property
    def samples_per_s(self) -> float:
        return self._samples / self._step_s if self._step_s > 0 else 0.0

    @property
    def loader_share(self) -> float:
        return self._wait_s / self._step_s if self._step_s > 0 else 0.0

    def left_s(self) -> float:
        """Seconds to the end of the schedule; training may stop earlier."""
        last = self._seen[-1]
        return (last.steps - last.step) * self._step_s / len(self._seen)


class JsonLines:
    """One JSON object a line: `progress` at intervals, and every epoch."""

    def __init__(self, place: str) -> None:
        self._place, self._pace = place, Pace()
        self._next_s = time.monotonic() + _LINE_EVERY_S

    def step(self, step: Step) -> None:
        self._pace.see(step)
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + _LINE_EVERY_S
        self._line(
            "progress",
            epoch=step.epoch,
            step=step.step,
            steps=step.steps,
            loss=round(step.loss, 5),
            samples_per_s=round(self._pace.samples_per_s, 1),
            loader_share=round(self._pace.loader_share, 4),
            left_s=round(self._pace.left_s()),
        )

    def epoch(self, record: dict[str, Any]) -> None:
        speed = {"samples_per_s": self._pace.samples_per_s, "loader_share": self._pace.loader_share}
        self._line("epoch", **record, **{name: round(value, 4) for name, value in speed.items()})

    def close(self) -> None:
        pass

    def _line(self, event: str, **values: object) -> None:
        sys.stderr.write(json.dumps({"event": event, "out": self._place, **values}) + "\n")
        sys.stderr.flush()


class TerminalBar:
    """A bar over all steps with loss, speed, time left and the loader's share; a line an epoch above it."""

    def __init__(self, steps: int, done: int = 0) -> None:
        self._pace, self._last = Pace(), None
        self._bar = Progress(
            TextColumn("[bold]steps"),
            BarColumn(bar_width=None),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            _Numbers(),
            console=Console(stderr=True),
            expand=True,
        )
        self._row = self._bar.add_task("steps", total=steps, completed=done, text="")
        self._bar.start()

    def step(self, step: Step) -> None:
        self._pace.see(step)
        text = (
            f"loss {step.loss:.4f}  {self._pace.samples_per_s:,.0f} samples/s  "
            f"{clock_text(self._pace.left_s())} left  data {self._pace.loader_share:.0%}"
        )
        self._bar.update(self._row, completed=step.step, text=text)

    def epoch(self, record: dict[str, Any]) -> None:
        balanced, auc = record["val_balanced_accuracy"], record["val_auc"]
        numbers = "".join(
            f"  {name} {value:.4f}"
            for name, value in (("balanced", balanced), ("AUC", auc))
            if value is not None
        )
        text = (
            f"epoch {record['epoch']:3d}  loss {record['loss']:.4f}  validation {record['val_loss']:.4f}  "
            f"accuracy {record['val_accuracy']:.4f}{numbers}{'  best' if record['best'] else ''}"
        )
        self._bar.console.print(Text(text), soft_wrap=True)

    def close(self) -> None:
        self._bar.stop()


class _Numbers(ProgressColumn):
    """The column of figures."""

    max_refresh = 0.2

    def __init__(self) -> None:
        super().__init__(table_column=Column(no_wrap=True))

    def render(self, task: Bar) -> Text:
        return Text(task.fields["text"], no_wrap=True, overflow="ellipsis")


def clock_text(seconds: float) -> str:
    """`h:mm:ss`."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def display(place: str, steps: int, done: int, as_json: bool) -> Watcher:
    """The display that suits standard error; `as_json` asks for lines on a terminal, too."""
    return JsonLines(place) if as_json or not sys.stderr.isatty() else TerminalBar(steps, done)
