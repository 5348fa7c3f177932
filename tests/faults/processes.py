"""Attempts in processes of this machine that may be killed at any time: workers as they are, without Ray."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from datagen.cluster.attempt_guard import Meter, failure_report, guarded, read_note
from datagen.cluster.protocol import AttemptOrder, AttemptReport, AttemptResult

T = TypeVar("T", bound=AttemptOrder)
# Forked from a driver that has one thread and has loaded everything: a new worker takes milliseconds. (A
# fork server would not do: it ends when a driver is killed in the moment of asking it.)
_FORKS = multiprocessing.get_context("fork")


@dataclass(eq=False)
class _Worker:
    process: Any
    pipe: Connection
    task: Any = None  # what it is at


class ProcessExecutor(Generic[T]):
    """`workers` processes that take tasks in turn; one that dies is replaced, and its attempt has crashed."""

    def __init__(self, function: Callable[[T, Meter], AttemptResult], workers: int) -> None:
        self._function, self.slots = function, workers
        self._queue: deque[T] = deque()
        self._ended: list[AttemptReport] = []
        self._killed: set[str] = set()
        self._workers: list[_Worker] = []
        for _ in range(workers):
            self._workers.append(self._new_worker())

    def _new_worker(self) -> _Worker:
        ours, theirs = _FORKS.Pipe()
        # The child must not hold the driver's ends of pipes open, or nobody sees that the driver is gone.
        inherited = [ours, *(worker.pipe for worker in self._workers)]
        process = _FORKS.Process(target=_work, args=(self._function, theirs, inherited), daemon=True)
        process.start()
        theirs.close()
        return _Worker(process, ours)

    def submit(self, task: T) -> None:
        self._queue.append(task)
        self._hand_out()

    def _hand_out(self) -> None:
        for worker in self._workers:
            if self._queue and worker.task is None:
                worker.task = self._queue.popleft()
                try:
                    worker.pipe.send(worker.task)
                except OSError:
                    continue  # it died while it was idle; `wait` sees that

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        ended, self._ended = self._ended, []
        busy = [worker for worker in self._workers if worker.task is not None]
        if not busy and not ended:
            time.sleep(timeout_s)
        ready = set(wait([worker.pipe for worker in busy], 0 if ended else timeout_s)) if busy else set()
        for worker in busy:
            if worker.pipe in ready:
                ended.append(self._report(worker))
        self._hand_out()
        return ended

    def _report(self, worker: _Worker) -> AttemptReport:
        task, worker.task = worker.task, None
        try:
            return worker.pipe.recv()
        except (EOFError, OSError):
            worker.pipe.close()
            self._workers[self._workers.index(worker)] = self._new_worker()
            if task.attempt in self._killed:
                return failure_report(task, "cancelled", "ended by force")
            return failure_report(task, "crashed", "the worker process died")

    def has_begun(self, attempt: str) -> bool:
        return any(
            w.task and w.task.attempt == attempt and read_note(w.task.notes, attempt) for w in self._workers
        )

    def kill(self, attempt: str) -> None:
        for task in [task for task in self._queue if task.attempt == attempt]:
            self._queue.remove(task)
            self._ended.append(failure_report(task, "cancelled", "ended by force"))
        for worker in self._workers:
            if worker.task is not None and worker.task.attempt == attempt:
                self._killed.add(attempt)
                os.kill(worker.process.pid, signal.SIGKILL)

    def close(self) -> None:
        """Let the workers end."""
        for worker in self._workers:
            worker.pipe.close()
        for worker in self._workers:
            worker.process.join()


def _work(
    function: Callable[[Any, Meter], AttemptResult], pipe: Connection, inherited: list[Connection]
) -> None:
    """A worker's life: until its driver closes the pipe, or is gone."""
    for other in inherited:
        other.close()
    while True:
        try:
            pipe.send(guarded(function, pipe.recv()))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return
