"""Run shards one after another in this process: for debuggers, small jobs and machines without Ray."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from datagen.cluster.attempt_guard import Meter, guarded
from datagen.cluster.protocol import AttemptOrder, AttemptReport, AttemptResult
from datagen.schemas.record_files import utc_now

T = TypeVar("T", bound=AttemptOrder)


class InProcessExecutor(Generic[T]):
    """Runs attempts inside `wait`, without a deadline: a hang or a crash is that of this process."""

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
        if self._queue:  # one at a time: the driver polls for stop requests in between
            task = self._queue.popleft()
            try:
                ended.append(guarded(self._function, task, deadline=False))
            except KeyboardInterrupt:
                # The second Ctrl-C interrupts the running shard (see stop_on_signals).
                ended += [_cancelled(t) for t in (task, *self._queue)]
                self._queue.clear()
        return ended

    def has_begun(self, attempt: str) -> bool:
        return False  # no attempt runs while the driver does

    def kill(self, attempt: str) -> None:
        for task in [t for t in self._queue if t.attempt == attempt]:
            self._queue.remove(task)
            self._cancelled.append(_cancelled(task))


def _cancelled(task: AttemptOrder) -> AttemptReport:
    return AttemptReport(task.attempt, task.shard, "cancelled", cause="the job was stopped", ended=utc_now())
