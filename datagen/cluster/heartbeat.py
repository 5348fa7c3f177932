"""Progress within running attempts, for the driver's display: a few bytes per worker in the job's notes.

Only workers on the driver's machine are read: a display is not worth requests over a network.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from datagen.schemas.run_records import STAGES

Watch = Callable[[str, int], None]
_BEAT, _SUFFIX = struct.Struct("<qq"), ".beat"  # stage by its place in STAGES, and labels


@dataclass(frozen=True)
class Running:
    """Sums over the attempts that run on this machine."""

    labels: int = 0  # made and not committed yet
    in_grasps: int = 0  # attempts that compute grasps, each of one object


def beat_path(folder: Path, attempt: str) -> Path:
    """The file of an attempt's progress."""
    return folder / f"{attempt}{_SUFFIX}"


@contextmanager
def beating(path: Path) -> Generator[Watch]:
    """Give a function that writes stage and labels to the file; the file is removed at the end.

    A call is one write without a seek, about 2 µs. Errors are ignored: progress is not worth an attempt.
    """
    number = -1
    with suppress(OSError):
        number = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)

    def watch(stage: str, labels: int) -> None:
        with suppress(OSError):
            os.pwrite(number, _BEAT.pack(STAGES.index(stage), labels), 0)

    try:
        yield watch
    finally:
        with suppress(OSError):
            os.close(number)
            path.unlink(missing_ok=True)


def running_here(folder: Path) -> Running:
    """The progress of the attempts whose files are in the folder."""
    labels = in_grasps = 0
    for path in folder.glob(f"*{_SUFFIX}"):
        with suppress(OSError, struct.error):  # it has ended meanwhile, or has not begun a stage
            stage, made = _BEAT.unpack(path.read_bytes())
            labels += made
            in_grasps += stage == STAGES.index("grasps")
    return Running(labels, in_grasps)
