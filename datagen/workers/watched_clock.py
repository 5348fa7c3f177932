"""A stage clock that reports how far its shard is."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass

from datagen.schemas.run_records import StageClock


@dataclass
class WatchedClock(StageClock):
    """Calls `watch(stage, labels)` when a stage begins: its name, and the labels made before it."""

    watch: Callable[[str, int], None] = lambda stage, labels: None
    labels: int = 0

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        self.watch(name, self.labels)
        with super().stage(name):
            yield


def count_label(clock: StageClock) -> None:
    """Count one label, for label sources that take long over each."""
    if isinstance(clock, WatchedClock):
        clock.labels += 1
