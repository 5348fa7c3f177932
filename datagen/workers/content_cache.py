"""A cache of computed arrays on disk, with atomic writes and least-recently-used removal.

No result depends on it. Damaged, foreign or too large files count as absent, and a read-only or full folder
stores nothing.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import stat
import time
import zipfile
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.archives import DAMAGED_ARRAY, DAMAGED_ZIP
from datagen.schemas.whole_files import whole_file

Arrays = Mapping[str, npt.NDArray[Any]]
# Type and shape of every array; lengths with one name are equal.
Layout = Mapping[str, tuple[type[np.generic], tuple[int | str, ...]]]

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
    layout: Layout
    most_files: int  # above it, the least recently used are removed
    most_bytes: int  # a larger file is not read

    def load(self, key: str) -> dict[str, npt.NDArray[Any]] | None:
        """The arrays stored under a key, or None. Reading counts as use."""
        path = self._path(key)
        found = read_arrays(path, {**self.layout, "key": (np.str_, ())}, self.most_bytes)
        if found is None or str(found.pop("key")) != key:
            return None
        refresh(path)
        return found

    def store(self, key: str, arrays: Arrays) -> None:
        """Stores arrays of the layout if the folder can be written."""
        path = self._path(key)
        if write_arrays(path, {**arrays, "key": np.array(key)}):
            drop_unused(path.parent, self.most_files)

    def _path(self, key: str) -> Path:
        return cache_folder() / self.folder / f"{key}.npz"


def read_arrays(path: Path, layout: Layout, most_bytes: int) -> dict[str, npt.NDArray[Any]] | None:
    """The arrays of an uncompressed npz file; None if it is damaged or does not match the layout."""
    arrays: dict[str, npt.NDArray[Any]] = {}
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > most_bytes:
            return None
        with zipfile.ZipFile(path) as archive:
            if {info.filename for info in archive.infolist()} != {f"{name}.npy" for name in layout}:
                return None
            for info in archive.infolist():
                # A small compressed file may unpack to more than the memory.
                if info.compress_type != zipfile.ZIP_STORED:
                    return None
                content = io.BytesIO(archive.read(info))  # checks the CRC before anything is parsed
                arrays[info.filename[:-4]] = np.lib.format.read_array(content, allow_pickle=False)
    except (OSError, *DAMAGED_ZIP, *DAMAGED_ARRAY):
        return None
    return arrays if _fits(arrays, layout) else None


def _fits(arrays: Arrays, layout: Layout) -> bool:
    lengths: dict[str, int] = {}
    for name, (kind, shape) in layout.items():
        dtype = arrays[name].dtype
        if dtype.type is not kind or not dtype.isnative or arrays[name].ndim != len(shape):
            return False
        for length, wanted in zip(arrays[name].shape, shape, strict=True):
            if length != (wanted if isinstance(wanted, int) else lengths.setdefault(wanted, length)):
                return False
    return True


def write_arrays(path: Path, arrays: Arrays) -> bool:
    """Writes a file for `read_arrays`; False if the folder cannot be written."""
    contents: Any = dict(arrays)
    try:
        with whole_file(path) as file:
            np.savez(file, **contents)
    except OSError:
        return False
    return True


def refresh(path: Path) -> bool:
    """Marks a file as used now; returns whether it exists."""
    try:
        os.utime(path)
    except OSError:
        return path.is_file()  # the file may belong to another user
    return True


def drop_unused(folder: Path, most: int, idle_s: float = 0.0) -> None:
    """Reduces a folder with more than `most` files to 7/8 of `most`, least recently used first.

    Keeps files used within `idle_s`, however many. Also removes incomplete files of killed processes.
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
    for used, path in sorted(files)[: len(files) - most + most // 8]:
        if now - used >= idle_s:
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def alone_in(folder: Path) -> Generator[None]:
    """Locks a folder against other callers. Raises OSError if the folder cannot be written."""
    with (folder / ".lock").open("ab") as file:
        with contextlib.suppress(OSError):  # some network file systems have no locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
