"""Shards one after another in this very process: for debuggers, small jobs and machines without Ray."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from datagen.cluster.attempt_guard import Meter, guarded
from datagen.cluster.task import AttemptReport, AttemptResult, Task
from datagen.schemas.record_files import utc_now

T = TypeVar("T", bound=Task)


class InProcessExecutor(Generic[T]):
    """Runs what was submitted inside `wait`. There is no deadline: a hang or a crash is the process's own."""

    slots = 1

    def __init__(self, function: Callable[[T, Meter], AttemptResult]) -> None:
        self._function = function
        self._queue: deque[T] = deque()
        self._cancelled: list[AttemptReport] = []

    def submit(self, task: T) -> None:
        self._queue.append(task)

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        if not self._queue and not self._cancelled:
            time.sleep(timeout_s)
        ended, self._cancelled = self._cancelled, []
        if self._queue:  # one at a time: between two the driver hears what is asked of it
            task = self._queue.popleft()
            try:
                ended.append(guarded(self._function, task, deadline=False))
            except KeyboardInterrupt:
                # The second Ctrl-C breaks into the running shard (see stop_on_signals).
                ended += [_cancelled(t) for t in (task, *self._queue)]
                self._queue.clear()
        return ended

    def has_begun(self, attempt: str) -> bool:
        return False  # nothing runs while the driver asks

    def kill(self, attempt: str) -> None:
        for task in [t for t in self._queue if t.attempt == attempt]:
            self._queue.remove(task)
            self._cancelled.append(_cancelled(task))


def _cancelled(task: Task) -> AttemptReport:
    return AttemptReport(task.attempt, task.shard, "cancelled", cause="the job was stopped", ended=utc_now())
