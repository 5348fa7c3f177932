"""Post-mortem check of an attempt: read the files that its worker left, and make a failure report.

Notes are kept in a folder of the worker's own machine, under a name unique to the job: a job on many
machines writes no small files over a network, and needs no folder that all of them share.
"""

from __future__ import annotations

import json
import secrets
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from datagen.cluster.task import AttemptReport, Task
from datagen.schemas.record_files import utc_now
from datagen.schemas.run_records import Cost, Host, Outcome

# Characters of a stack that a ledger entry keeps, from its end, where the failing frame is.
STACK_LIMIT = 16_000
_CAUSE_LIMIT = 300  # a cause is read in a table and on a progress line; the stack has the whole text


def short_line(text: str) -> str:
    """The text as one short line."""
    line = " ".join(text.split())
    return line if len(line) <= _CAUSE_LIMIT else line[: _CAUSE_LIMIT - 3] + "..."


@dataclass(frozen=True)
class Note:
    """The note that a worker wrote about its process when it began an attempt."""

    host: Host
    started: str


@dataclass(frozen=True)
class PostMortem:
    """The files that a dead worker left of an attempt: its note, and its last stack ("" for none)."""

    note: Note | None = None
    stack: str = ""


@contextmanager
def notes_of_a_job() -> Generator[str]:
    """Give the folder name of one job's notes on each machine; this machine's are removed at the end."""
    name = f"datagen-notes-{secrets.token_hex(8)}"
    try:
        yield name
    finally:
        clear_notes(name)


def clear_notes(notes: str) -> None:
    """Remove this machine's notes of a job."""
    shutil.rmtree(_folder(notes), ignore_errors=True)


def read_note(notes: str, attempt: str) -> Note | None:
    """This machine's note of an attempt that has begun and not ended by itself; None when there is none."""
    if not notes:
        return None
    try:
        found = json.loads(note_path(notes, attempt).read_text())
    except FileNotFoundError:
        return None
    return Note(Host(**found["host"]), found["started"])


def collect_post_mortem(notes: str, attempt: str) -> PostMortem:
    """Read, and remove, the note and the stack file that a dead worker left on this machine."""
    if not notes:
        return PostMortem()
    note, path = read_note(notes, attempt), stack_path(notes, attempt)
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - STACK_LIMIT))
            stack = file.read(STACK_LIMIT).decode(errors="replace")
    except FileNotFoundError:
        stack = ""
    path.unlink(missing_ok=True)
    note_path(notes, attempt).unlink(missing_ok=True)
    return PostMortem(note, stack)


def failure_report(task: Task, outcome: Outcome, cause: str, left: PostMortem | None = None) -> AttemptReport:
    """The report of an attempt whose worker died, from its files on this machine, or from `left`.

    A cause of many lines is cut to one; where the worker left no stack, its whole text is the stack.
    A stack that begins with faulthandler's timeout line means a hang, not a crash. The wall time is
    counted from the note; the CPU time is lost with the process, and is 0.
    """
    left, ended = left or collect_post_mortem(task.notes, task.attempt), utc_now()
    note, stack = left.note, left.stack
    line = short_line(cause)
    if line != cause:
        stack, cause = stack or cause[-STACK_LIMIT:], line
    if outcome == "crashed" and stack.startswith("Timeout ("):
        outcome, cause = "hung", f"still running after its deadline of {task.deadline_s:g} s"
    elif outcome == "crashed" and stack.startswith("Fatal Python error"):
        cause = stack.splitlines()[0]
    wall_s = 0.0
    if note is not None:
        wall_s = (datetime.fromisoformat(ended) - datetime.fromisoformat(note.started)).total_seconds()
    return AttemptReport(
        task.attempt,
        task.shard,
        outcome,
        cause=cause,
        stack=stack,
        started=note.started if note else "",
        ended=ended,
        cost=Cost(wall_s=max(0.0, wall_s), cpu_s=0.0) if note else None,
        host=note.host if note else None,
    )


def _folder(notes: str) -> Path:
    return Path(tempfile.gettempdir(), notes)  # an absolute path is used as it is


def note_path(notes: str, attempt: str) -> Path:
    """The file in which the worker of an attempt describes its process."""
    return _folder(notes) / f"{attempt}.json"


def stack_path(notes: str, attempt: str) -> Path:
    """The file to which `faulthandler` writes the stack of a dying worker."""
    return _folder(notes) / f"{attempt}.stack"
