"""What driver, executors and workers exchange: tasks, reports, totals, and requests to stop."""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import cache
from hashlib import sha256
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType
from typing import Literal, Protocol, TypeVar, get_args

import datagen
from datagen.schemas.run_records import Commit, Cost, Host, Layout, Outcome
from datagen.schemas.specification import Specification
from datagen.schemas.storage.errors import StoreUnavailable, repeated_until


@cache
def code_digest() -> str:
    """sha256 over the names and bytes of the package's Python files, computed once per process."""
    root, whole = Path(datagen.__file__).parent, sha256()
    for path in sorted(root.rglob("*.py")):
        whole.update(f"{path.relative_to(root)}\0{path.stat().st_size}\0".encode())
        whole.update(path.read_bytes())
    return whole.hexdigest()


T_contra = TypeVar("T_contra", contravariant=True)
End = Literal["complete", "failed", "interrupted", "aborted"]  # each worse than the one before
_STORE_S = 15.0  # for which a stopped job waits for a store that fails
EXIT_CODES = {"failed": 1, "aborted": 2, "interrupted": 130}  # exit codes; 0 for other ends


@dataclass(frozen=True)
class AttemptOrder:
    """The driver's parameters of an attempt: all that executors and the guard know of a task.

    `attempt` is a file name, unique over all drivers of the run. `notes` is the folder, within the machine's
    temporary folder, for the worker's process id and stack, unique to the job; "" for none. An absolute path
    is used as it is.
    """

    shard: int
    attempt: str
    deadline_s: float
    may_be_done: bool = True  # another attempt may have committed the shard
    notes: str = ""


@dataclass(frozen=True, kw_only=True)
class ShardTask(AttemptOrder):
    """One attempt of one shard. Equal tasks give equal arrays on every machine."""

    run: str  # folder or URL of the run
    spec: Specification
    layout: Layout
    houses: str  # source reference as on the command line: `builtin`, `procthor:DIR`
    objects: str
    robot: str = ""  # place of the robot's file; "" for one of the registry
    scenes_from: str = ""  # folder or URL of the run whose scenes are labelled again; "" for new scenes
    probe: str = ""  # a file of the run by which machines recognize it; "" for none
    code_digest: str = field(default_factory=code_digest)  # of the driver's code

    @property
    def scene_indices(self) -> range:
        first = self.shard * self.layout.scenes_per_shard
        return range(first, first + self.layout.scenes_per_shard)


@dataclass(frozen=True)
class AttemptResult:
    """Result of a task function that reached its commit."""

    won: bool  # False where another attempt was committed before
    labels: int
    positives: int
    cost: Cost
    commit: Commit | None = None  # this attempt's own


@dataclass(frozen=True)
class AttemptReport:
    """How one attempt ended. Executors make it for dead workers."""

    attempt: str
    shard: int
    outcome: Outcome
    cause: str = ""  # one line
    stack: str = ""
    started: str = ""  # UTC, ISO 8601; "" when it never began
    ended: str = ""
    labels: int = 0
    positives: int = 0
    cost: Cost | None = None
    host: Host | None = None
    commit: Commit | None = None
    # The job cannot continue: every attempt would fail (full disk, sources missing).
    ends_job: bool = False
    # It cannot be made on its machine. Executors with other machines continue on these.
    is_unfit: bool = False


class Executor(Protocol[T_contra]):
    """Runs attempts. Every submitted attempt gives one report, whatever happens to it.

    `slots`: attempts that can run at the same time now. `wait` returns reports of ended attempts, as soon as
    there is one, or none after the timeout. The report of a killed attempt has outcome `cancelled`.
    """

    @property
    def slots(self) -> int: ...
    def submit(self, task: T_contra, /) -> None: ...
    def wait(self, timeout_s: float, /) -> list[AttemptReport]: ...
    def has_begun(self, attempt: str, /) -> bool: ...
    def kill(self, attempt: str, /) -> None: ...


class JobCannotContinue(Exception):
    """Raised by a task function for an error that no retry can fix. Its text is one line with the fix."""


class UnfitMachine(JobCannotContinue):
    """Raised where this machine cannot make any shard of the run; another one may."""


@dataclass
class JobTotals:
    """Counts since this driver began. Seconds are sums over attempts."""

    shards: int  # this job's, without those done before
    committed: int = 0
    superseded: int = 0  # shards that another driver or an earlier attempt had committed
    elsewhere: int = 0  # shards that another driver had committed before an attempt began here
    quarantined: int = 0
    retries: int = 0
    in_flight: int = 0
    outcomes: Counter[Outcome] = field(default_factory=Counter)  # attempts by how they ended
    labels: int = 0
    positives: int = 0
    useful_wall_s: float = 0.0
    useful_cpu_s: float = 0.0
    wasted_wall_s: float = 0.0
    wasted_cpu_s: float = 0.0

    @property
    def finished(self) -> int:
        """Shards that need no further attempt."""
        return self.committed + self.superseded + self.elsewhere + self.quarantined

    def count(self, report: AttemptReport) -> None:
        self.outcomes[report.outcome] += 1
        wall_s, cpu_s = (report.cost.wall_s, report.cost.cpu_s) if report.cost else (0.0, 0.0)
        if report.outcome == "committed":
            self.committed += 1
            self.labels += report.labels
            self.positives += report.positives
            self.useful_wall_s += wall_s
            self.useful_cpu_s += cpu_s
        else:
            self.superseded += report.outcome == "superseded"
            self.wasted_wall_s += wall_s
            self.wasted_cpu_s += cpu_s

    def plus(self, other: JobTotals) -> JobTotals:
        sums = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(JobTotals)}
        return JobTotals(**sums)


@dataclass(frozen=True)
class JobSummary:
    """How a job ended.

    complete: every shard is committed or, within the allowed share, quarantined. interrupted: by a stop
    request. failed: too many shards are quarantined. aborted: `cause` names an error that no retry can fix,
    and its fix.
    """

    end: End = "complete"
    cause: str = ""
    totals: JobTotals = field(default_factory=lambda: JobTotals(0))
    elapsed_s: float = 0.0
    start_s: float = 0.0  # before the driver began

    @property
    def remaining(self) -> int:
        return self.totals.shards - self.totals.finished

    def plus(self, later: JobSummary) -> JobSummary:
        """The sum of both, for one job over several runs, with the worse end and its first cause."""
        worst = max(self, later, key=lambda summary: get_args(End).index(summary.end))
        totals = self.totals.plus(later.totals)
        return JobSummary(worst.end, worst.cause, totals, self.elapsed_s + later.elapsed_s)


class StopRequest:
    """Counts stop requests. Safe to use in a signal handler."""

    def __init__(self) -> None:
        self._count = 0
        # When to give up an object store that fails, by the monotonic clock.
        self.store_until_s = float("inf")

    def ask(self) -> None:
        self._count += 1
        self.store_until_s = time.monotonic() + (_STORE_S if self._count == 1 else 0.0)

    @property
    def drain(self) -> bool:
        """Whether to start nothing more and wait a bounded time for running attempts."""
        return self._count >= 1

    @property
    def force(self) -> bool:
        return self._count >= 2


@contextmanager
def interrupted_by_sigterm() -> Generator[None]:
    """Make SIGTERM raise KeyboardInterrupt within the block, as Ctrl-C does; the handler is restored."""
    if current_thread() is not main_thread():  # Python lets the main thread alone handle signals
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def stop_on_signals(stop: StopRequest, interrupt: bool = False) -> Generator[StopRequest]:
    """Make Ctrl-C and SIGTERM stop requests within the block; the handlers are restored after it.

    A store that fails ends a stopped block soon, with KeyboardInterrupt.

    With `interrupt` the second signal also raises KeyboardInterrupt, which is the only way to stop shards
    that run in this process.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        stop.ask()
        if interrupt and stop.force:
            raise KeyboardInterrupt

    # Python lets the main thread alone handle signals; a job in another one is stopped by `datagen cancel`.
    numbers = (signal.SIGINT, signal.SIGTERM) if current_thread() is main_thread() else ()
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        with repeated_until(lambda: stop.store_until_s):
            yield stop
    except StoreUnavailable as error:
        if stop.drain:
            raise KeyboardInterrupt from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
