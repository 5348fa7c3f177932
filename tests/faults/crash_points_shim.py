"""The shim that ends or fails one call of a process: built by the C compiler, armed from Python."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

SOURCE = Path(__file__).with_name("crash_points_shim.c")


class Mode(IntEnum):
    """What happens at the chosen call. Numbers are those of the C file."""

    KILL = 1  # before the call is made
    KILL_HALF_WRITTEN = 2  # after half of the bytes of a write
    FAIL_ONCE = 3
    FAIL_FROM_HERE = 4  # every later call fails too that needs room on the disk
    COUNT = 5  # nothing


@dataclass(frozen=True)
class Call:
    """One call that changes files: its kind and its path."""

    kind: str
    path: str


def build(folder: Path) -> Path:
    """The shim as a shared library in the folder. RuntimeError says why it cannot be had here."""
    compiler = shutil.which(os.environ.get("CC", "cc"))
    if compiler is None:
        raise RuntimeError("no C compiler (cc) to build the shim with")
    library = folder / "crash_points_shim.so"
    command = [compiler, "-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror"]
    done = subprocess.run(
        [*command, "-o", str(library), str(SOURCE), "-ldl"], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise RuntimeError(f"{compiler} cannot build the shim: {done.stderr.strip()[:500]}")
    return library


class Shim:
    """The shim in this process, which must have been started with it in LD_PRELOAD."""

    def __init__(self, library: Path) -> None:
        self._library = ctypes.CDLL(str(library))
        loaded = ctypes.CDLL(None)
        if not hasattr(loaded, "crash_points_arm"):
            raise RuntimeError(f"{library} is not preloaded")

    def arm(self, folder: Path, mode: Mode, at: int = 0, error: int = 0, log: int = -1) -> None:
        """From now on count the calls below the folder; at number `at` (from 1) do what the mode says."""
        self._library.crash_points_arm(
            os.fsencode(folder), int(mode), ctypes.c_long(at), int(error), int(log)
        )

    def disarm(self) -> None:
        """Let all calls pass."""
        self._library.crash_points_disarm()


def read_log(text: str) -> list[Call]:
    """The calls that a process counted."""
    return [Call(*line.split(" ", 1)) for line in text.splitlines()]
