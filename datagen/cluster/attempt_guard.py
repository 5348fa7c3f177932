"""Runs an attempt in its worker: deadline with stack, note of the process, cost; post-mortem of a dead one.

A killed worker cannot report. Therefore it first writes a note of its process and points `faulthandler` at a
file next to it, from which `failure_report` makes its report. Notes are kept in a folder of the worker's own
machine, under a name unique to the job: a job on many machines writes no small files over a network, and
needs no folder that all of them share.
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
import struct
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TypeVar

import psutil

from datagen.cluster.protocol import (
    AttemptOrder,
    AttemptReport,
    AttemptResult,
    JobCannotContinue,
    UnfitMachine,
)
from datagen.schemas.record_files import utc_now
from datagen.schemas.run_records import STAGES, Cost, Host, Outcome, StageClock
from datagen.schemas.safe_files import is_private, whole_file
from datagen.schemas.storage.errors import (
    FULL,
    StoreRefuses,
    StoreUnavailable,
    machine_error,
    repeated_for_minutes,
)

T = TypeVar("T", bound=AttemptOrder)

# Characters of a stack that a ledger entry keeps, from its end, where the failing frame is.
STACK_LIMIT = 16_000
_CAUSE_LIMIT = 300  # a cause is read in a table and on a progress line; the stack has the whole text


class Meter:
    """Measures the cost of an attempt from its creation on, and passes its progress on."""

    def __init__(self) -> None:
        self.watch: Watch | None = None  # reports the attempt's progress to the driver's display
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        # Linux: resets VmHWM to the current memory, so that the peak is the attempt's.
        with suppress(OSError):  # otherwise the peak is that of the whole process
            Path("/proc/self/clear_refs").write_text("5")

    def cost(self, clock: StageClock | None = None, written_bytes: int = 0) -> Cost:
        """The cost so far. Time outside the stages of `clock` has no stage."""
        clock = clock or StageClock()
        return Cost(
            wall_s=time.perf_counter() - self._wall,
            cpu_s=time.process_time() - self._cpu,
            stage_wall_s=clock.wall_s,
            stage_cpu_s=clock.cpu_s,
            peak_rss_bytes=_peak_memory_bytes(),
            written_bytes=written_bytes,
        )


def guarded(function: Callable[[T, Meter], AttemptResult], task: T, deadline: bool = True) -> AttemptReport:
    """Run one attempt and return its report. Exceptions become failed reports with their stack.

    With `deadline`, the process exits when the task takes longer than `task.deadline_s`, even where native
    code hangs while it holds the GIL.
    """
    meter = Meter()
    begun = AttemptReport(task.attempt, task.shard, "failed", started=utc_now(), host=this_host())
    try:
        beats = beating(beat_path(task.notes, task.attempt)) if task.notes else nullcontext()
        with _notes(task, begun.started, deadline), beats as meter.watch, repeated_for_minutes():
            try:
                product = function(task, meter)
            except Exception as error:  # noqa: BLE001 - reported with its stack, whatever it is
                return _failure(begun, meter, error)
    except (OSError, JobCannotContinue) as error:  # from writing the note
        return _failure(begun, meter, error)
    return replace(
        begun,
        outcome="committed" if product.won else "superseded",
        ended=utc_now(),
        labels=product.labels,
        positives=product.positives,
        cost=product.cost,
        commit=product.commit,
    )


def _failure(begun: AttemptReport, meter: Meter, error: Exception) -> AttemptReport:
    # An unreachable store concerns every shard; a full disk for caches and notes, and missing libraries,
    # every shard of this machine.
    of_job = isinstance(error, JobCannotContinue | StoreUnavailable)
    final = error if of_job or isinstance(error, ImportError) else machine_error(error, FULL)
    cause = " ".join(str(final or error).split())
    return replace(
        begun,
        outcome="out_of_memory" if isinstance(error, MemoryError) else "failed",
        cause=cause if final else short_line(f"{type(error).__name__}: {cause}"),
        stack=traceback.format_exc()[-STACK_LIMIT:],
        ended=utc_now(),
        cost=meter.cost(),
        ends_job=final is not None,
        is_unfit=final is not None and (not of_job or isinstance(error, UnfitMachine | StoreRefuses)),
    )


@contextmanager
def _notes(task: AttemptOrder, started: str, deadline: bool) -> Generator[None]:
    if not task.notes:
        yield
        return
    note, stack = note_path(task.notes, task.attempt), stack_path(task.notes, task.attempt)
    note.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not is_private(note.parent.lstat()):
        problem = f"{note.parent}: belongs to another user, or other users can write to it"
        raise JobCannotContinue(f"{problem}. Set TMPDIR to a folder of your own")
    with whole_file(note, alone=True) as file:
        file.write(json.dumps({"host": this_host().model_dump(), "started": started}).encode())
    if not deadline:  # the caller's own process keeps its signal handlers
        try:
            yield
        finally:
            note.unlink(missing_ok=True)
        return
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver handles Ctrl-C
    with stack.open("w") as file:
        faulthandler.enable(file)  # also writes the stack of a native crash
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


def _peak_memory_bytes() -> int:
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def short_line(text: str) -> str:
    """The text as one short line."""
    line = " ".join(text.split())
    return line if len(line) <= _CAUSE_LIMIT else line[: _CAUSE_LIMIT - 3] + "..."


@dataclass(frozen=True)
class Note:
    """What a worker left of an attempt: its process, when it began, and its last stack ("" for none)."""

    host: Host | None = None
    started: str = ""
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


def collect_post_mortem(notes: str, attempt: str) -> Note:
    """Read, and remove, the note and the stack file that a dead worker left on this machine."""
    if not notes:
        return Note()
    note, path = read_note(notes, attempt) or Note(), stack_path(notes, attempt)
    with suppress(FileNotFoundError), path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - STACK_LIMIT))
        note = replace(note, stack=file.read(STACK_LIMIT).decode(errors="replace"))
    for file in (path, note_path(notes, attempt), beat_path(notes, attempt)):
        file.unlink(missing_ok=True)
    return note


def failure_report(
    task: AttemptOrder, outcome: Outcome, cause: str, left: Note | None = None
) -> AttemptReport:
    """The report of an attempt whose worker died, from its files on this machine, or from `left`.

    A cause of many lines is cut to one; where the worker left no stack, its whole text is the stack.
    A stack that begins with faulthandler's timeout line means a hang, not a crash. The wall time is
    counted from the note; the CPU time is lost with the process, and is 0.
    """
    left, ended = left or collect_post_mortem(task.notes, task.attempt), utc_now()
    stack = left.stack
    line = short_line(cause)
    if line != cause:
        stack, cause = stack or cause[-STACK_LIMIT:], line
    if outcome == "crashed" and stack.startswith("Timeout ("):
        outcome, cause = "hung", f"still running after its deadline of {task.deadline_s:g} s"
    elif outcome == "crashed" and stack.startswith("Fatal Python error"):
        cause = stack.splitlines()[0]
    wall_s = 0.0
    if left.host is not None:
        wall_s = (datetime.fromisoformat(ended) - datetime.fromisoformat(left.started)).total_seconds()
    return AttemptReport(
        task.attempt,
        task.shard,
        outcome,
        cause=cause,
        stack=stack,
        started=left.started,
        ended=ended,
        cost=Cost(wall_s=max(0.0, wall_s), cpu_s=0.0) if left.host else None,
        host=left.host,
    )


def _folder(notes: str) -> Path:
    return Path(tempfile.gettempdir(), notes)  # an absolute path is used as it is


def note_path(notes: str, attempt: str) -> Path:
    """The file in which the worker of an attempt describes its process."""
    return _folder(notes) / f"{attempt}.json"


def stack_path(notes: str, attempt: str) -> Path:
    """The file to which `faulthandler` writes the stack of a dying worker."""
    return _folder(notes) / f"{attempt}.stack"


# Progress within attempts, for the display: a few bytes per worker in the notes, read on the driver's machine
# alone, since a display is not worth requests over a network.
Watch = Callable[[str, int], None]
_BEAT, _SUFFIX = struct.Struct("<qq"), ".beat"  # stage by its place in STAGES, and labels


@dataclass(frozen=True)
class Running:
    """Sums over the attempts that run on this machine."""

    labels: int = 0  # made and not committed yet
    in_grasps: int = 0  # attempts that compute grasps, each of one object


def beat_path(notes: str, attempt: str) -> Path:
    """The file of an attempt's progress."""
    return _folder(notes) / f"{attempt}{_SUFFIX}"


@contextmanager
def beating(path: Path) -> Generator[Watch]:
    """Give a function that writes stage and labels to the file; the file is removed at the end.

    A call is one write without a seek, about 2 µs. Errors are ignored: progress is not worth an attempt.
    """
    number = -1
    with suppress(OSError):
        number = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)

    def watch(stage: str, labels: int) -> None:
        with suppress(OSError):
            os.pwrite(number, _BEAT.pack(STAGES.index(stage), labels), 0)

    try:
        yield watch
    finally:
        with suppress(OSError):
            os.close(number)
            path.unlink(missing_ok=True)


def running_attempts(notes: str) -> Running:
    """The progress of the attempts of a job that run on this machine."""
    labels = in_grasps = 0
    for path in _folder(notes).glob(f"*{_SUFFIX}") if notes else ():
        with suppress(OSError, struct.error):  # it has ended meanwhile, or has not begun a stage
            stage, made = _BEAT.unpack(path.read_bytes())
            labels += made
            in_grasps += stage == STAGES.index("grasps")
    return Running(labels, in_grasps)
