"""Runs an attempt in its worker: deadline with stack, note of the process, cost.

A killed worker cannot report. Therefore it first writes a note of its process and points `faulthandler` at a
file next to it. `post_mortem` makes a failure report from both.
"""

from __future__ import annotations

import faulthandler
import json
import os
import platform
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import psutil

from datagen.cluster.post_mortem import STACK_LIMIT, note_path, short_line, stack_path
from datagen.cluster.task import AttemptReport, AttemptResult, JobCannotContinue, Task
from datagen.schemas.cost import StageClock
from datagen.schemas.locked_folders import is_private
from datagen.schemas.record_files import utc_now
from datagen.schemas.run_records import Cost, Host
from datagen.schemas.storage.errors import FULL, StoreUnavailable, machine_error
from datagen.schemas.whole_files import whole_file

T = TypeVar("T", bound=Task)


class Meter:
    """Measures the cost of an attempt from its creation on."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        _reset_peak_memory()

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
        with _notes(task, begun.started, deadline):
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
    )


def _failure(begun: AttemptReport, meter: Meter, error: Exception) -> AttemptReport:
    # An unreachable store or a full disk concerns every shard.
    final = error if isinstance(error, JobCannotContinue | StoreUnavailable) else machine_error(error, FULL)
    cause = " ".join(str(final or error).split())
    return replace(
        begun,
        outcome="out_of_memory" if isinstance(error, MemoryError) else "failed",
        cause=cause if final else short_line(f"{type(error).__name__}: {cause}"),
        stack=traceback.format_exc()[-STACK_LIMIT:],
        ended=utc_now(),
        cost=meter.cost(),
        ends_job=final is not None,
    )


@contextmanager
def _notes(task: Task, started: str, deadline: bool) -> Generator[None]:
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


def _reset_peak_memory() -> None:
    # Linux: resets VmHWM to the current memory, so that the peak is the attempt's.
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return  # otherwise the peak is that of the whole process


def _peak_memory_bytes() -> int:
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def resident_bytes() -> int:
    """Resident memory of this process (bytes)."""
    return psutil.Process().memory_info().rss
