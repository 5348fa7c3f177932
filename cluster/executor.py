"""The interface of executors, which run attempts for the driver."""

from __future__ import annotations

from typing import Protocol, TypeVar

from datagen.cluster.task import AttemptReport

T_contra = TypeVar("T_contra", contravariant=True)


class Executor(Protocol[T_contra]):
    """Runs attempts. Every submitted attempt gives one report, whatever happens to it."""

    @property
    def slots(self) -> int:
        """Attempts that can run at the same time now."""
        ...

    def submit(self, task: T_contra, /) -> None:
        """Start an attempt; return at once."""
        ...

    def wait(self, timeout_s: float, /) -> list[AttemptReport]:
        """Reports of ended attempts, as soon as there is one, or none after the timeout."""
        ...

    def has_begun(self, attempt: str, /) -> bool:
        """Whether a worker has begun the attempt."""
        ...

    def kill(self, attempt: str, /) -> None:
        """Kill an attempt. Its report follows through `wait`, with outcome `cancelled`."""
        ...
