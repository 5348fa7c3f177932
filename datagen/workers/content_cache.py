"""A cache of computed arrays on disk, with atomic writes and least-recently-used removal.

No result depends on it. Damaged files count as absent, and a read-only or full folder stores nothing.
"""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.safe_files import DAMAGED_ARRAY, DAMAGED_ZIP, whole_file

Arrays = Mapping[str, npt.NDArray[Any]]

_ABANDONED_S = 3600.0  # an incomplete file of this age belongs to a killed process


def cache_folder() -> Path:
    """`DATAGEN_CACHE`, else `datagen` in the user's cache folder (XDG base directories).

    If the user has no home, an unusable path below /dev/null: one in /tmp could be another user's.
    """
    if explicit := os.environ.get("DATAGEN_CACHE"):
        return Path(explicit)
    try:
        home = Path.home()
    except RuntimeError:  # a container may run a user id without a home
        home = Path(os.devnull)
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "datagen"


@dataclass(frozen=True)
class CacheFolder:
    """Named arrays in one folder of the cache; a file's key covers everything that decides its content."""

    folder: str  # below the cache folder
    most_files: int  # above it, the least recently used are removed

    def load(self, key: str) -> dict[str, npt.NDArray[Any]] | None:
        """The arrays stored under a key, or None. Reading counts as use."""
        path = self._path(key)
        try:
            with path.open("rb") as file, np.load(file) as stored:
                found = dict(stored)  # checks the CRC of every array
        except (OSError, *DAMAGED_ZIP, *DAMAGED_ARRAY):
            return None
        if str(found.pop("key", "")) != " ".join([key, *sorted(found)]):
            return None  # the file of another key, or damaged names
        refresh(path)
        return found

    def store(self, key: str, arrays: Arrays) -> None:
        """Stores arrays if the folder can be written."""
        path = self._path(key)
        contents: Any = {**arrays, "key": np.array(" ".join([key, *sorted(arrays)]))}
        with contextlib.suppress(OSError):
            with whole_file(path) as file:
                np.savez(file, **contents)
            drop_unused(path.parent, self.most_files)

    def computed(self, key: str, compute: Callable[[], Arrays]) -> Arrays:
        """The arrays stored under a key, or else those that `compute` returns, which are then stored."""
        if (stored := self.load(key)) is None:
            self.store(key, stored := compute())
        return stored

    def _path(self, key: str) -> Path:
        return cache_folder() / self.folder / f"{key}.npz"


@cache
def version_of(package: str) -> str:
    """The version of an installed package, for keys of what it computes."""
    try:
        return version(package)
    except PackageNotFoundError:  # installed without metadata, as conda packages can be
        return ""


def refresh(path: Path) -> None:
    """Marks a file as used now."""
    with contextlib.suppress(OSError):  # the file may belong to another user
        os.utime(path)


def drop_unused(folder: Path, most: int) -> None:
    """Reduces a folder with more than `most` files to 7/8 of `most`, least recently used first.

    Also removes incomplete files of killed processes.
    """
    try:
        paths = list(folder.iterdir())
    except OSError:
        return
    if len(paths) <= most:
        return
    files: list[tuple[float, Path]] = []
    now = time.time()
    for path in paths:
        # Another process may remove the same files meanwhile.
        with contextlib.suppress(OSError):
            status = path.lstat()
            if not stat.S_ISREG(status.st_mode):
                continue
            if not path.name.startswith("."):
                files.append((status.st_mtime, path))
            elif path.suffix == ".tmp" and now - status.st_mtime > _ABANDONED_S:
                path.unlink()
    if len(files) <= most:
        return
    for _, path in sorted(files)[: len(files) - most + most // 8]:
        with contextlib.suppress(OSError):
            path.unlink()
