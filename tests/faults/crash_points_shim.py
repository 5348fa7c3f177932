"""Stands before the calls of `os` that change files, and ends or fails one of them below a folder."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path
from typing import Any


class Mode(Enum):
    """What happens at the chosen call."""

    KILL = auto()  # before the call is made
    KILL_HALF_WRITTEN = auto()  # after half of the bytes of a write
    FAIL_ONCE = auto()
    FAIL_FROM_HERE = auto()  # every later call fails too that needs room on the disk
    COUNT = auto()  # nothing


@dataclass(frozen=True)
class Call:
    """One call that changes files: its kind and its path."""

    kind: str
    path: str


class Shim:
    """Counts calls below `folder`, and does at number `at` (from 1) what the mode says. `log` is a file."""

    def __init__(self, folder: Path, mode: Mode, at: int = 0, error: int = 0, log: int = -1) -> None:
        self._folder, self._mode, self._at, self._error, self._log = folder, mode, at, error, log
        self._calls = 0
        self._write = os.write
        os.open = self._opening(os.open)
        os.write = self._writing(os.write)
        for name in ("mkdir", "rename", "link", "unlink", "rmdir", "fsync"):
            setattr(os, name, self._before(name, getattr(os, name)))

    def disarm(self) -> None:
        """Let all calls pass."""
        self._folder = Path("/dev/null")

    def _opening(self, real: Callable[..., int]) -> Callable[..., int]:
        def call(path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
            if flags & (os.O_CREAT | os.O_TRUNC | os.O_WRONLY | os.O_RDWR):
                self._gate("open", bool(flags & os.O_CREAT), path, dir_fd)
            return real(path, flags, mode, dir_fd=dir_fd)

        return call

    def _writing(self, real: Callable[..., int]) -> Callable[..., int]:
        def call(fd: int, data: Any) -> int:
            if self._gate("write", True, fd):
                real(fd, data[: len(data) // 2])
                os.kill(os.getpid(), signal.SIGKILL)
            return real(fd, data)

        return call

    def _before(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *more: Any, **options: Any) -> Any:
            folder = options.get("dir_fd", options.get("dst_dir_fd"))
            # A link is the name that it makes.
            self._gate(name, name not in ("unlink", "rmdir"), more[0] if name == "link" else path, folder)
            return real(path, *more, **options)

        return call

    def _gate(self, kind: str, takes_room: bool, path: Any, dir_fd: int | None = None) -> bool:
        """Count and log one call, and end or fail the chosen one; whether half of it is to be done."""
        fd = path if isinstance(path, int) else dir_fd
        base = Path.cwd() if fd is None else Path(f"/proc/self/fd/{fd}").readlink()
        name = base if isinstance(path, int) else base / path
        if name.is_relative_to(self._folder):
            self._calls += 1
            if self._log >= 0:
                self._write(self._log, f"{kind} {name}\n".encode())
            is_it = self._calls == self._at
            if is_it and self._mode is Mode.KILL_HALF_WRITTEN and kind == "write":
                return True
            if is_it and self._mode in (Mode.KILL, Mode.KILL_HALF_WRITTEN):
                os.kill(os.getpid(), signal.SIGKILL)
            fails_on = self._mode is Mode.FAIL_FROM_HERE and self._calls >= self._at and takes_room
            if fails_on or (is_it and self._mode is Mode.FAIL_ONCE):
                raise OSError(self._error, os.strerror(self._error), name)
        return False


def read_log(text: str) -> list[Call]:
    """The calls that a process counted."""
    return [Call(*line.split(" ", 1)) for line in text.splitlines()]
