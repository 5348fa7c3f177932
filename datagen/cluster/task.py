"""Data sent to a worker and back, an immutable task and a small report; and the interface of executors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

from datagen.schemas.run_records import Cost, Host, Layout, Outcome
from datagen.schemas.specification import Specification

T_contra = TypeVar("T_contra", contravariant=True)


class Task(Protocol):
    """The interface of tasks for executors and the guard.

    `attempt` is a file name, unique over all drivers of the run. `notes` is the folder, within the machine's
    temporary folder, for the worker's process id and stack, unique to the job; "" for none. An absolute path
    is used as it is.
    """

    @property
    def shard(self) -> int: ...
    @property
    def attempt(self) -> str: ...
    @property
    def deadline_s(self) -> float: ...
    @property
    def notes(self) -> str: ...


@dataclass(frozen=True)
class ShardTask:
    """One attempt of one shard. Equal tasks give equal arrays on every machine."""

    run: str  # folder or URL of the run
    spec: Specification
    layout: Layout
    shard: int
    attempt: str
    houses: str  # source reference as on the command line: `builtin`, `procthor:DIR`
    objects: str
    deadline_s: float
    notes: str = ""
    scenes_from: str = ""  # folder or URL of the run whose scenes are labelled again; "" for new scenes

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
    # The job cannot continue: every attempt would fail (full disk, sources missing).
    ends_job: bool = False


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
