"""What travels to a worker and what comes back: one immutable key, one small report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from datagen.schemas.run_records import Cost, Host, Layout, Outcome
from datagen.schemas.specification import Specification


class Task(Protocol):
    """What every executor and the guard need to know of a unit of work."""

    @property
    def shard(self) -> int: ...

    @property
    def attempt(self) -> str:
        """Name of this execution, unique over all drivers of the run, usable as a file name."""
        ...

    @property
    def deadline_s(self) -> float: ...

    @property
    def notes(self) -> str:
        """Name of the folder, in its machine's folder for temporary files, in which the worker leaves
        its process id and its stack; "" for none. Unique to the job; an absolute path stands as it is.
        """
        ...


@dataclass(frozen=True)
class ShardTask:
    """One attempt at one shard. Equal keys give equal arrays, wherever they run."""

    run: str  # folder or URL of the run
    spec: Specification
    layout: Layout
    shard: int
    attempt: str
    houses: str  # source reference, as the command line takes it: `builtin`, `procthor:DIR`
    objects: str
    deadline_s: float
    notes: str = ""
    scenes_from: str = ""  # folder or URL of the run whose scenes are labelled again; "" draws new ones

    @property
    def scene_indices(self) -> range:
        """The scenes of this shard in the run's endless sequence."""
        first = self.shard * self.layout.scenes_per_shard
        return range(first, first + self.layout.scenes_per_shard)


@dataclass(frozen=True)
class AttemptResult:
    """What a task function answers when it reached its commit."""

    won: bool  # False when another attempt had committed the shard before
    labels: int
    positives: int
    cost: Cost


@dataclass(frozen=True)
class AttemptReport:
    """How one attempt ended. Executors write it for workers that can no longer do so."""

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
    # The job cannot go on: no other attempt could end differently (full disk, sources missing).
    ends_job: bool = False


class JobCannotContinue(Exception):
    """Raised by a task function for what no retry can cure. Its text is one line with the mend."""
