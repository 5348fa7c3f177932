"""What a process does that waits; it imports no more than it needs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from datagen.train.training.launching import Ranks


def wait_for_stop(job: str, ranks: Ranks, stopping: Callable[[], bool]) -> bool:
    """Say by the job's file that this rank is there, and wait."""
    Path(job).touch()
    while not stopping():
        time.sleep(0.05)
    return True
