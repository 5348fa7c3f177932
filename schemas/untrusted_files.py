"""Files that a user or another file names: regular ones alone, of at most the expected size."""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

from datagen.schemas.errors import InputError


def open_regular(path: Path, most_bytes: int, mend: str) -> BufferedReader:
    """The file, open for reading.

    Raises InputError, with `mend`, for one that is missing, cannot be read or is larger, and for a folder, a
    pipe or a device: the opening of a pipe waits for a writer, and a device has no end.
    """
    try:
        # Looked at before it is opened, which some devices act on, and after, as it may be replaced between.
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(path, "", "is not a file", mend)
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    except OSError as error:
        raise InputError(path, "", f"cannot be read: {error.strerror or error}", mend) from None
    except InputError:
        raise
    except ValueError:  # a NUL, or a character that no file name holds
        raise InputError(repr(str(path)), "", "is not a file", mend) from None
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= most_bytes:
        return file
    file.close()
    problem = f"has {status.st_size:,} bytes, more than the {most_bytes:,} allowed"
    raise InputError(path, "", problem if stat.S_ISREG(status.st_mode) else "is not a file", mend)


def read_regular(path: Path, most_bytes: int, mend: str) -> bytes:
    """The bytes of a file. Raises InputError as `open_regular` does."""
    with open_regular(path, most_bytes, mend) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:  # it grew, or is one of /proc, whose sizes are 0
        raise InputError(path, "", f"has more than {most_bytes:,} bytes", mend)
    return data
