"""Private temporary folders of this user, each locked by its process while that runs."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

_remove_tree = partial(shutil.rmtree, ignore_errors=True)


@contextmanager
def locked_folder(
    kind: str, parent: Path, remove: Callable[[Path], object] = _remove_tree
) -> Generator[Path]:
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
