"""Processes that answer calls, one a core."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

_answers: list[Callable[..., Any]] = []  # the one of this process


class WorkerProcesses:
    """Processes that each call what `make` returns there; it, its arguments and errors must be picklable."""

    def __init__(self, make: Callable[[], Callable[..., Any]]) -> None:
        self._make = make
        self._start()

    def _start(self) -> None:
        context, count = multiprocessing.get_context("spawn"), len(os.sched_getaffinity(0))
        self._pool = ProcessPoolExecutor(count, context, _begin, (self._make,))
        for _ in range(count):
            self._pool.submit(int)  # starts a process

    async def __aenter__(self) -> None:
        """They run from the first on."""

    async def __aexit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    async def call(self, *args: Any) -> Any:
        """The function's result. BrokenProcessPool where a process ended; new ones answer the next call."""
        pool = self._pool
        try:
            return await asyncio.wrap_future(pool.submit(_call, *args))
        except BrokenProcessPool:
            if pool is self._pool:
                self._start()
            raise


def _begin(make: Callable[[], Callable[..., Any]]) -> None:
    """Set up a process. It ends with its parent, which alone handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
    _answers.append(make())


def _call(*args: Any) -> Any:
    return _answers[0](*args)
