"""The worker's side of an attempt: deadline with stack, process notes, account of the cost.

A worker that is killed cannot answer. So it first writes who it is into a small note, and points
`faulthandler` at a file beside it: whatever ends the process, the driver finds what is known. Notes
are kept in a folder of the worker's own machine, under a name that is the job's alone: a job on many
machines writes no small files over a network, and needs no folder that all of them share.
"""

from __future__ import annotations

import faulthandler
import json
import os
import platform
import resource
import secrets
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TypeVar

import psutil

from datagen.cluster.task import AttemptReport, JobCannotGoOn, Product, Task
from datagen.schemas.cost import StageClock
from datagen.schemas.private_folders import is_private
from datagen.schemas.run_records import Cost, Host, Outcome
from datagen.schemas.storage.errors import FULL, StoreFailure, machine_error
from datagen.schemas.whole_files import whole_file

T = TypeVar("T", bound=Task)
# What a ledger entry keeps of a stack, from its end, where the failing frame is.
STACK_LIMIT = 16_000
_CAUSE_LIMIT = 300  # a cause is read in a table and on a progress line; the stack has the whole text


def utc_now() -> str:
    """The time, UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def short_line(text: str) -> str:
    """The text as one short line."""
    line = " ".join(text.split())
    return line if len(line) <= _CAUSE_LIMIT else line[: _CAUSE_LIMIT - 3] + "..."


class Meter:
    """Counts what an attempt costs from the moment it is made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        _reset_peak_memory()

    def cost(self, clock: StageClock | None = None, written_bytes: int = 0) -> Cost:
        """The cost so far. What no stage of `clock` claimed is wall and CPU time without a name."""
        clock = clock or StageClock()
        return Cost(
            wall_s=time.perf_counter() - self._wall,
            cpu_s=time.process_time() - self._cpu,
            stage_wall_s=clock.wall_s,
            stage_cpu_s=clock.cpu_s,
            peak_rss_bytes=_peak_memory_bytes(),
            written_bytes=written_bytes,
        )


def guarded(function: Callable[[T, Meter], Product], task: T, deadline: bool = True) -> AttemptReport:
    """Run one attempt and tell how it ended. Exceptions become failed reports with their stack.

    With `deadline`, the process ends itself when the task takes longer than `task.deadline_s`,
    also when native code hangs with the interpreter's lock held.
    """
    started, meter = utc_now(), Meter()
    try:
        with _notes(task, started, deadline):
            try:
                product = function(task, meter)
            except Exception as error:  # noqa: BLE001 - reported with its stack, whatever it is
                return _failure(task, started, meter, error)
    except (OSError, JobCannotGoOn) as error:  # of the note itself
        return _failure(task, started, meter, error)
    return AttemptReport(
        attempt=task.attempt,
        shard=task.shard,
        outcome="committed" if product.won else "superseded",
        started=started,
        ended=utc_now(),
        labels=product.labels,
        positives=product.positives,
        cost=product.cost,
        host=this_host(),
    )


def _failure(task: Task, started: str, meter: Meter, error: Exception) -> AttemptReport:
    # A store that gives no answer gives none to the next shard either, and a full disk stays full.
    final = error if isinstance(error, JobCannotGoOn | StoreFailure) else machine_error(error, FULL)
    cause = " ".join(str(final or error).split())
    return AttemptReport(
        attempt=task.attempt,
        shard=task.shard,
        outcome="out_of_memory" if isinstance(error, MemoryError) else "failed",
        cause=cause if final else short_line(f"{type(error).__name__}: {cause}"),
        stack=traceback.format_exc()[-STACK_LIMIT:],
        started=started,
        ended=utc_now(),
        cost=meter.cost(),
        host=this_host(),
        ends_job=final is not None,
    )


@contextmanager
def _notes(task: Task, started: str, deadline: bool) -> Generator[None]:
    """Keep the note and the stack file of an attempt while it runs, and remove them after it."""
    if not task.notes:
        yield
        return
    note, stack = _note_path(task.notes, task.attempt), _stack_path(task.notes, task.attempt)
    note.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not is_private(note.parent.lstat()):
        problem = f"{note.parent}: another user's folder, or others can write to it"
        raise JobCannotGoOn(f"{problem}. Name a folder of your own as TMPDIR")
    with whole_file(note, alone=True) as file:
        file.write(json.dumps({"host": this_host().model_dump(), "started": started}).encode())
    if not deadline:  # the caller's own process: it must outlive the attempt, and keeps its handlers
        try:
            yield
        finally:
            note.unlink(missing_ok=True)
        return
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the driver's to handle
    with stack.open("w") as file:
        faulthandler.enable(file)  # a native crash leaves its stack here too
        faulthandler.dump_traceback_later(task.deadline_s, exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            faulthandler.disable()
    if sys.__stderr__ is not None:
        faulthandler.enable(sys.__stderr__)
    note.unlink(missing_ok=True)
    stack.unlink(missing_ok=True)


@dataclass(frozen=True)
class Note:
    """What a worker wrote about itself when it began an attempt."""

    host: Host
    started: str


@dataclass(frozen=True)
class Remains:
    """What a dead worker left of an attempt: its note, and the stack that it died with ("" for none)."""

    note: Note | None = None
    stack: str = ""


@contextmanager
def notes_of_a_job() -> Generator[str]:
    """The name under which machines keep their notes of one job; this one's are removed at the end."""
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
        found = json.loads(_note_path(notes, attempt).read_text())
    except FileNotFoundError:
        return None
    return Note(Host(**found["host"]), found["started"])


def collect_remains(notes: str, attempt: str) -> Remains:
    """What a dead worker left of an attempt on this machine; note and stack file are removed."""
    if not notes:
        return Remains()
    note, path = read_note(notes, attempt), _stack_path(notes, attempt)
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - STACK_LIMIT))
            stack = file.read(STACK_LIMIT).decode(errors="replace")
    except FileNotFoundError:
        stack = ""
    path.unlink(missing_ok=True)
    _note_path(notes, attempt).unlink(missing_ok=True)
    return Remains(note, stack)


def obituary(task: Task, outcome: Outcome, cause: str, remains: Remains | None = None) -> AttemptReport:
    """The report of an attempt whose worker is gone, from what it left behind: here, or `remains`.

    A cause of many lines is cut to one; where the worker left no stack, its whole text stands there.
    A stack that begins with faulthandler's timeout line tells a hang from a crash. The wall time is
    counted from the note; CPU time went with the process and is 0.
    """
    left, ended = remains or collect_remains(task.notes, task.attempt), utc_now()
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
    return Path(tempfile.gettempdir(), notes)  # which an absolute path replaces


def _note_path(notes: str, attempt: str) -> Path:
    return _folder(notes) / f"{attempt}.json"


def _stack_path(notes: str, attempt: str) -> Path:
    return _folder(notes) / f"{attempt}.stack"


@cache
def this_host() -> Host:
    """Fingerprint of this machine and process."""
    cpu = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = (
            line.split(":", 1)[1]
            for line in cpuinfo.read_text().splitlines()
            if line.startswith("model name")
        )
        cpu = next(names, cpu).strip()
    memory = psutil.virtual_memory().total
    return Host(
        name=platform.node(), cpu=cpu, cores=os.cpu_count() or 1, memory_bytes=memory, pid=os.getpid()
    )


def _reset_peak_memory() -> None:
    # Linux: makes VmHWM start again from what is resident now, so that the peak is the attempt's.
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return  # elsewhere, or forbidden: the peak is then that of the whole process


def _peak_memory_bytes() -> int:
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def resident_bytes() -> int:
    """Memory that this process holds now."""
    return psutil.Process().memory_info().rss
