"""Read untrusted files: only regular ones, of a bounded size."""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

from datagen.schemas.errors import InputError


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


def read_regular(path: Path, most_bytes: int, fix: str) -> bytes:
    """Return the bytes of a file. Raises InputError as `open_regular` does."""
    with open_regular(path, most_bytes, fix) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:  # it grew, or is in /proc, where sizes are 0
        raise InputError(path, "", f"has more than {most_bytes:,} bytes", fix)
    return data
