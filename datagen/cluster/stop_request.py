"""A request to stop a job: once to finish attempts in flight, twice to end at once."""

from __future__ import annotations

import signal
from collections.abc import Generator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType


class StopRequest:
    """Counts stop requests. Safe to use in a signal handler."""

    def __init__(self) -> None:
        self._count = 0

    def ask(self) -> None:
        self._count += 1

    @property
    def drain(self) -> bool:
        """Whether to start nothing more and wait a bounded time for running attempts."""
        return self._count >= 1

    @property
    def force(self) -> bool:
        return self._count >= 2


@contextmanager
def stop_on_signals(stop: StopRequest, interrupt: bool = False) -> Generator[StopRequest]:
    """Make Ctrl-C and SIGTERM stop requests within the block; the handlers are restored after it.

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
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
