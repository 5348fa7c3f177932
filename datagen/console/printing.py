"""Output of verbs: tables for people, JSON for programs.

Records of a run may come from another user, so control characters are escaped, and brackets are not markup.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from datagen.display.progress import Progress
from datagen.schemas.errors import printable
from datagen.workers.kinematics import on_compiling


def print_json(value: Any) -> None:
    """Print one JSON document to standard output.

    ValueError, before any output, for values that JSON cannot hold.
    """
    sys.stdout.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def print_rows(title: str, rows: Sequence[Sequence[str]], heads: Sequence[str] = ()) -> None:
    """Print a table. With `heads`: nothing without rows, and all columns but the first right-aligned."""
    if heads and not rows:
        return
    table = Table(show_header=bool(heads), box=None, padding=(0, 2, 0, 0))
    for k in range(len(heads)) if heads else range(2):
        table.add_column(
            Text(printable(heads[k])) if heads else "", justify="right" if heads and k else "left"
        )
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)
    # Printed separately: rich wraps a table's own title to the table's width.
    console.print(Text(printable(title), style="italic"), soft_wrap=True)
    console.print(table)


def print_lines(text: str, indent: str = "") -> None:
    """Print the lines of a text."""
    sys.stdout.writelines(f"{indent}{printable(line)}\n" for line in text.splitlines())
    sys.stdout.flush()


def drop_output() -> None:
    """Send further standard output nowhere. Without this, Python reports a second error when it exits."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def compiling_shown(as_json: bool = False) -> Generator[None]:
    """Show a line of progress where opening a robot compiles, before it does."""
    text = "compiling kinematics for this machine, once: about 5 s"
    with Progress(as_json) as progress, on_compiling(lambda: progress.say("compiling", {"text": text}, text)):
        yield


@contextmanager
def summary_of_stored() -> Generator[None]:
    """Drop a summary that cannot be printed: the result that it is about is stored."""
    try:
        yield
        sys.stdout.flush()
    except (OSError, SystemExit) as error:  # rich raises SystemExit for a closed pipe
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        drop_output()


def new_labels(made: int, wanted: int) -> str:
    """The labels that a job made; a run's last shard may hold more than are read."""
    if made > wanted:
        return f"{made:,} new in whole shards; readers get the {wanted:,} wanted"
    return f"{made:,} new of {wanted:,} wanted"


def counted(n: int, what: str) -> str:
    """A count with its noun: 1 shard, 1,200 shards."""
    return f"{n:,} {what}" if n == 1 else f"{n:,} {what}s"


def listed(values: Sequence[object]) -> str:
    """The first ten values: 3, 5, 8, ..."""
    return ", ".join(map(str, values[:10])) + (", ..." if len(values) > 10 else "")


def seconds(value: float) -> str:
    """A duration: 0.8 s, 3 min 20 s, 2 h 5 min, 3.1 days."""
    if value < 60:
        return f"{value:.2g} s" if value < 1 else f"{value:.1f} s"
    if value < 3600:
        return f"{int(value // 60)} min {int(value % 60)} s"
    if value < 48 * 3600:
        return f"{int(value // 3600)} h {int(value % 3600 // 60)} min"
    return f"{value / 86400:.1f} days"


def size(value: float) -> str:
    """A size in bytes with its unit: 1.2 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} TB"
