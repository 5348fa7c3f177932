"""Write files atomically by renaming: readers see no file, the old one or the new one.

Files of runs are written by `datagen.schemas.storage`, which also handles crashes.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO
from uuid import uuid4


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
