"""Files below one folder of this machine, opened without following symbolic links.

A run may come from another user and contain links to anything. Every method therefore walks down from the
root through open folder descriptors, which also prevents races, and refuses all but folders and regular
files. Failures are OSErrors; refusals are InputErrors.
"""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from datagen.schemas.safe_files import sync_folder
from datagen.schemas.storage.errors import TAKEN, NotARegularFile, storage_error, too_large

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
# Enough to traverse a folder, without permission to read it.
_STEP = getattr(os, "O_PATH", os.O_RDONLY) | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
# Without O_NONBLOCK, opening a pipe waits for a writer.
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_DRAFT = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_MAX_DEPTH = 32
_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@dataclass(frozen=True, slots=True)
class StoredFile:
    """One listed file: its key below the storage's root, its size in bytes, and the time of its last write.

    `modified_s` is in seconds since 1970 UTC.
    """

    key: str
    size: int
    modified_s: float = 0.0


class LocalFiles:
    """The methods of `Storage` for a folder. The root itself, given by the user, may be a link."""

    def __init__(self, root: Path, prefix: tuple[str, ...] = ()) -> None:
        self.root, self.prefix = root, prefix
        self.folder = root.joinpath(*prefix)
        self._durable: set[tuple[str, ...]] = set()  # folders whose own names are durable, from the root

    @staticmethod
    def make_root(folder: Path) -> None:
        missing = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        for path in missing:
            sync_folder(path.parent)

    def below(self, key: str) -> LocalFiles:
        return LocalFiles(self.root, (*self.prefix, *key.split("/")))

    def put(self, key: str, data: bytes, durably: bool) -> None:
        folders, name = _split(key)
        with _closing(self._walk(folders, make=True)) as here, _drafted(name, here) as draft:
            _write(draft, data, here, durably)
            os.rename(draft, name, src_dir_fd=here, dst_dir_fd=here)
        if durably:
            self._sync_folders(folders)

    def create(self, key: str, data: bytes) -> bool:
        """Write a file durably unless the name exists; False where it does.

        The bytes are on disk before the name, so that a power cut cannot leave an empty file.
        """
        folders, name = _split(key)
        with _closing(self._walk(folders, make=True)) as here, _drafted(name, here) as draft:
            _write(draft, data, here, durably=True)
            try:
                os.link(draft, name, src_dir_fd=here, dst_dir_fd=here, follow_symlinks=False)
            except FileExistsError:
                return False
        self._sync_folders(folders)
        return True

    def get(self, key: str, limit_bytes: int) -> bytes | None:
        with suppress(FileNotFoundError), _closing(self._open_file(key)) as fd:
            size = os.fstat(fd).st_size
            if size > limit_bytes:
                raise too_large(f"{self.folder}/{key}", size, limit_bytes)
            with open(fd, "rb", closefd=False) as file:
                return file.read(size)
        return None

    def get_range(self, key: str, start: int, size: int) -> bytes | None:
        with suppress(FileNotFoundError), _closing(self._open_file(key)) as fd:
            end = os.fstat(fd).st_size
            return os.pread(fd, min(size, end), start if start >= 0 else max(0, end + start))
        return None

    def exists(self, key: str) -> bool:
        folders, name = _split(key)
        with suppress(FileNotFoundError), _closing(self._walk(folders)) as here:
            mode = os.stat(name, dir_fd=here, follow_symlinks=False).st_mode
            self._refuse_odd(mode, key)
            return stat.S_ISREG(mode)
        return False

    def list(self, prefix: str) -> Iterator[StoredFile]:
        """All files below a folder; none when it does not exist. InputError for links, pipes, devices."""
        try:
            here = self._walk(prefix.split("/") if prefix else (), flags=_FOLDER)
        except FileNotFoundError:
            return
        with _closing(here):
            yield from self._list(here, f"{prefix}/" if prefix else "", 0)

    def delete(self, keys: Iterable[str]) -> None:
        """Remove files; missing ones are ignored. A link itself is removed, not its target."""
        for key in keys:
            folders, name = _split(key)
            with suppress(FileNotFoundError), _closing(self._walk(folders)) as here:
                os.unlink(name, dir_fd=here)

    def remove_empty(self, folder: str) -> None:
        """Remove a folder and its subfolders, where they hold no file."""
        folders, name = _split(folder)
        self._durable.clear()
        with suppress(FileNotFoundError), _closing(self._walk(folders)) as here:
            for _, below, _, fd in os.fwalk(name, topdown=False, dir_fd=here):
                for child in below:
                    _remove_folder(child, fd)
            _remove_folder(name, here)

    def sync(self, key: str) -> None:
        """Make a file of another process durable."""
        with _closing(self._open_file(key)) as fd:
            os.fsync(fd)
        self._sync_folders(_split(key)[0])

    def _sync_folders(self, folders: tuple[str, ...]) -> None:
        """Make a new name in a folder durable, and where the folder may be new, those of its parents."""
        path, files = (*self.prefix, *folders), LocalFiles(self.root)
        new = range(len(path), len(path) - 1 if path in self._durable else -1, -1)
        for folder in (path[:depth] for depth in new):
            try:
                with _closing(files._walk(folder, flags=_FOLDER)) as fd:
                    os.fsync(fd)
            except OSError as e:
                raise storage_error(self.root.joinpath(*folder), e) from e
        self._durable.add(path)

    def _walk(self, folders: Sequence[str], make: bool = False, flags: int = _STEP) -> int:
        """Open a folder; the caller closes the descriptor. With `make`, missing ones are created."""
        here = os.open(self.root, flags & ~os.O_NOFOLLOW)
        for name in (*self.prefix, *folders):
            try:
                below = _step(name, here, make, flags)
            except OSError as e:
                if e.errno in (errno.ENOTDIR, errno.ELOOP):
                    with suppress(FileNotFoundError):
                        mode = os.stat(name, dir_fd=here, follow_symlinks=False).st_mode
                        self._refuse_odd(mode, "/".join(folders), f"{name!r} in this path is ")
                raise
            finally:
                os.close(here)
            here = below
        return here

    def _open_file(self, key: str) -> int:
        folders, name = _split(key)
        with _closing(self._walk(folders)) as here:
            mode = os.stat(name, dir_fd=here, follow_symlinks=False).st_mode
            if not stat.S_ISREG(mode):
                self._refuse_odd(mode, key)
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), key)
            return os.open(name, _FILE, dir_fd=here)

    def _list(self, folder: int, prefix: str, depth: int) -> Iterator[StoredFile]:
        if depth > _MAX_DEPTH:
            fix = "It was not written by datagen: remove it"
            raise NotARegularFile(f"{self.folder}/{prefix}", "", "folders are nested too deeply", fix)
        with os.scandir(folder) as entries:
            for entry in entries:
                key = prefix + entry.name
                try:
                    seen = entry.stat(follow_symlinks=False)
                    is_folder = stat.S_ISDIR(seen.st_mode)
                    below = os.open(entry.name, _FOLDER, dir_fd=folder) if is_folder else -1
                except FileNotFoundError:
                    continue  # removed since the listing
                if is_folder:
                    with _closing(below):
                        yield from self._list(below, f"{key}/", depth + 1)
                else:
                    self._refuse_odd(seen.st_mode, key)
                    yield StoredFile(key, seen.st_size, seen.st_mtime)

    def _refuse_odd(self, mode: int, key: str, where: str = "") -> None:
        kind = _KINDS.get(stat.S_IFMT(mode))
        if kind is not None:
            place = f"{self.folder}/{key}"
            fix = "Remove it, or replace it by a copy of the file"
            raise NotARegularFile(place, "", f"{where or 'is '}{kind}, which a run never has", fix)


@contextmanager
def _closing(fd: int) -> Generator[int]:
    """Give an open descriptor, and close it when the block ends."""
    try:
        yield fd
    finally:
        os.close(fd)


@contextmanager
def _drafted(name: str, folder: int) -> Generator[str]:
    draft = f"{name}.{secrets.token_hex(8)}.part"
    try:
        yield draft
    finally:
        with suppress(FileNotFoundError):
            os.unlink(draft, dir_fd=folder)


def _split(key: str) -> tuple[tuple[str, ...], str]:
    *folders, name = key.split("/")
    return tuple(folders), name


def _remove_folder(name: str, here: int) -> None:
    try:
        os.rmdir(name, dir_fd=here)
    except OSError as e:
        if e.errno not in (*TAKEN, errno.ENOENT):
            raise


def _step(name: str, here: int, make: bool, flags: int) -> int:
    while True:
        try:
            return os.open(name, flags, dir_fd=here)
        except FileNotFoundError:
            if not make:
                raise
            with suppress(FileExistsError):
                os.mkdir(name, dir_fd=here)


def _write(draft: str, data: bytes, folder: int, durably: bool) -> None:
    left = memoryview(data)
    with _closing(os.open(draft, _DRAFT, 0o666, dir_fd=folder)) as fd:
        while left:
            left = left[os.write(fd, left) :]
        if durably:
            os.fsync(fd)
