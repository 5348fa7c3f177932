"""The wish to stop: once to finish what is in flight, twice to end at once."""

from __future__ import annotations

import signal
from collections.abc import Generator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType


class StopRequest:
    """Counts how often somebody asked to stop. Safe to set from a signal handler."""

    def __init__(self) -> None:
        self._asked = 0

    def ask(self) -> None:
        self._asked += 1

    @property
    def drain(self) -> bool:
        """Submit nothing more, wait a bounded time for what is in flight."""
        return self._asked >= 1

    @property
    def force(self) -> bool:
        """End what is in flight now."""
        return self._asked >= 2


@contextmanager
def stop_on_signals(stop: StopRequest, interrupt: bool = False) -> Generator[StopRequest]:
    """Let Ctrl-C and SIGTERM ask `stop` while the block runs; the former handlers come back after.

    With `interrupt` the second signal also raises KeyboardInterrupt: shards that run in this very
    process cannot be ended in another way.
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
