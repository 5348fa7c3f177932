"""The time at which a command began, for the durations that it reports."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar

_with_process: ContextVar[bool] = ContextVar("_with_process", default=False)


@contextmanager
def began_with_process() -> Generator[None]:
    """Let a command of this block begin with its process, so that its time includes imports."""
    token = _with_process.set(True)
    try:
        yield
    finally:
        _with_process.reset(token)


def beginning_s() -> float:
    """Monotonic time at which a command began: its process on the command line, else now."""
    if not _with_process.get():
        return time.monotonic()
    import psutil

    return time.monotonic() - max(0.0, time.time() - psutil.Process().create_time())
