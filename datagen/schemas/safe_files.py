"""Files outside runs: written whole, read only where regular and bounded, and private folders of this user.

Files of runs are written by `datagen.schemas.storage`, which also handles crashes.
"""

from __future__ import annotations

import fcntl
import os
import stat
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import IO
from uuid import uuid4

from datagen.schemas.errors import InputError


@contextmanager
def whole_file(
    path: Path, *, mode: int = 0o666, durable: bool = False, alone: bool = False
) -> Generator[IO[bytes]]:
    """Give a temporary file that is renamed when the block succeeds; folders are created.

    Several processes may write one name concurrently. `alone` is for a name with one writer at a time, whose
    leftover draft the next one replaces. `durable` files are on the disk when the block ends. Raises OSError.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.new" if alone else f".{path.name}.{uuid4().hex}.tmp")
    if alone:
        draft.unlink(missing_ok=True)
    try:
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            yield file
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(draft, path)
    except OSError as error:
        error.filename = error.filename or str(path)  # a full disk names no file
        raise
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
    if durable:
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable. Raises OSError."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def open_regular(path: Path, most_bytes: int, fix: str) -> BufferedReader:
    """Open the file for reading.

    Raises InputError, with `fix`, where it is missing, unreadable or too large, or a folder, a pipe or a
    device: opening a pipe waits for a writer, and a device has no end.
    """
    try:
        # Checked before it is opened, since opening a device may have effects, and after, against races.
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(path, "", "is not a file", fix)
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    except OSError as error:
        raise InputError(path, "", f"cannot be read: {error.strerror or error}", fix) from None
    except InputError:
        raise
    except ValueError:  # a NUL, or an invalid character
        raise InputError(repr(str(path)), "", "is not a file", fix) from None
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= most_bytes:
        return file
    file.close()
    problem = f"has {status.st_size:,} bytes, more than the {most_bytes:,} allowed"
    raise InputError(path, "", problem if stat.S_ISREG(status.st_mode) else "is not a file", fix)


def is_inside(folder: Path, path: Path) -> bool:
    """Whether a path leads to something in the folder, also through links."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # a zero byte, a name too long, a loop of links
        return False


def read_regular(path: Path, most_bytes: int, fix: str) -> bytes:
    """Return the bytes of a file. Raises InputError as `open_regular` does."""
    with open_regular(path, most_bytes, fix) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:  # it grew, or is in /proc, where sizes are 0
        raise InputError(path, "", f"has more than {most_bytes:,} bytes", fix)
    return data


@contextmanager
def locked_folder(kind: str, parent: Path, remove: Callable[[Path], object]) -> Generator[Path]:
    """Give a new folder of mode 0700, whose name begins with `kind`; `remove` removes it after the block.

    First removes folders of killed processes of this user, whose locks the kernel has released.
    """
    for left in parent.glob(f"{kind}*"):
        if (held := _lock(left, fcntl.LOCK_EX)) is not None:
            remove(left)
            os.close(held)
    folder, held = parent, None
    while held is None:  # another process may have removed it before it was locked
        folder = Path(tempfile.mkdtemp(prefix=kind, dir=parent))
        held = _lock(folder, fcntl.LOCK_SH)
    try:
        yield folder
    finally:
        remove(folder)
        os.close(held)


def is_private(status: os.stat_result) -> bool:
    """Whether a file or folder belongs to this user, and no other user can write to it."""
    return status.st_uid == os.getuid() and not status.st_mode & 0o022


def _lock(folder: Path, kind: int) -> int | None:
    """A descriptor that locks this user's folder until the process ends; None where it is locked."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    with suppress(OSError):
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        about = os.fstat(descriptor)
        if is_private(about) and os.path.samestat(about, folder.lstat()):
            return descriptor
    os.close(descriptor)
    return None


# Exceptions of zipfile for the directory, and for a member of `open_member`.
DAMAGED_ZIP = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,  # a truncated member
    RuntimeError,  # an encrypted member; its subclass NotImplementedError: an unknown version or method
    # An offset before the start of the file, or a bad member; UnicodeDecodeError for a name not in UTF-8.
    ValueError,
)
# Exceptions of numpy.lib.format for an array's header, which it parses as Python, and for its bytes.
DAMAGED_ARRAY = (
    ValueError,
    SyntaxError,
    tokenize.TokenError,  # an unclosed bracket or string
    TypeError,  # keys of mixed types, or unhashable ones
    LookupError,  # an empty description of a type
    OverflowError,  # an axis longer than the index type
    EOFError,
    MemoryError,  # deeply nested brackets, or more items than memory
    RecursionError,
)
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def open_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> IO[bytes]:
    """Open a stored or deflated member. Raises one of `DAMAGED_ZIP`; ValueError for other methods.

    Damaged bzip2 raises OSError as a failing disk does, and an LZMA header can claim up to 4 GiB of memory.
    """
    if member.compress_type not in _METHODS:
        method = member.compress_type
        raise ValueError(f"{member.filename!r} has compression method {method}, neither stored nor deflated")
    return archive.open(member)
