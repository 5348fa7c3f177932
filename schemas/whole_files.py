"""Files that are written aside and renamed: whoever reads one sees nothing, the old one or the new one.

Files of runs are written by `datagen.schemas.storage`, which also counts on what a crash leaves.
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
    """A file that appears under its name when the block ends, or not at all; folders are made.

    Several processes may write one name at once. `alone` is for a name that one process writes at a time:
    what a killed one left half written is then replaced by the next. `durable` files are on the disk when
    the block ends, whatever happens to the machine. Raises OSError.
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
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
