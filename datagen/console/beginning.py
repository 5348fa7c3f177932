"""When a command began, for the times that it reports."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar

_with_process: ContextVar[bool] = ContextVar("_with_process", default=False)


@contextmanager
def began_with_process() -> Generator[None]:
    """In the block a command began with its process, so that imports are in its time."""
    token = _with_process.set(True)
    try:
        yield
    finally:
        _with_process.reset(token)


def beginning_s() -> float:
    """By the monotonic clock: when this process began on the command line; else now."""
    if not _with_process.get():
        return time.monotonic()
    import psutil

    return time.monotonic() - max(0.0, time.time() - psutil.Process().create_time())
