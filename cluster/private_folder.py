"""Folders below /tmp that only this user can enter, and the processes that belong to them.

Ray opens its own folders to everybody, so each cluster of this machine has its folder inside a closed one.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import psutil

_PARENT = Path("/tmp")  # sockets need a short path
_KIND = "datagen-ray-"
_STOP_WITHIN_S = 4.0  # politely; some of Ray's processes ignore that

# Variable that names the folder to each process that belongs to it; Ray reads it too.
OWNER = "RAY_TMPDIR"
RAY = "ray"  # the part that Ray writes to, and opens to everybody who can reach it


@contextmanager
def private_folder() -> Generator[Path]:
    """Give a new folder of mode 0700; when the block ends, its processes are ended and it is removed.

    First removes what killed programs of this user left. A lock that the kernel releases when its owner
    dies tells those from living ones.
    """
    _remove_abandoned()
    folder = new_folder(_KIND)
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (folder / RAY).mkdir()  # from here on another program may ask whether it is abandoned
        yield folder
    finally:
        remove_folder(folder)
        os.close(lock)


def new_folder(kind: str) -> Path:
    """A new folder below /tmp with mode 0700; its name begins with `kind`."""
    return Path(tempfile.mkdtemp(prefix=kind, dir=_PARENT))


def write_private(path: Path, text: str) -> None:
    """Write a file of mode 0600 that appears whole."""
    draft = path.with_suffix(f".{os.getpid()}.part")
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)
    draft.replace(path)


def is_private(status: os.stat_result) -> bool:
    """Whether a file or folder is this user's, and nobody else can write to it."""
    return status.st_uid == os.getuid() and not status.st_mode & 0o022


def remove_folder(folder: Path) -> None:
    """End every process of this user that belongs to a private folder, and remove it."""
    end_processes([p for p in psutil.process_iter() if _belongs(p, str(folder))])
    shutil.rmtree(folder, ignore_errors=True)


def end_processes(processes: list[psutil.Process]) -> None:
    """SIGTERM, and SIGKILL some seconds later to those that are still there."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        for process in processes:
            try:
                process.send_signal(number)
            except psutil.Error:
                continue
        _, processes = psutil.wait_procs(processes, timeout=_STOP_WITHIN_S)


def _remove_abandoned() -> None:
    """Remove the private folders of this user whose owners are dead."""
    for folder in _PARENT.glob(f"{_KIND}*"):
        try:
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:
            continue  # another user's, or no folder
        try:
            if is_private(os.fstat(lock)) and (folder / RAY).is_dir():
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove_folder(folder)
        except BlockingIOError:
            continue  # its owner lives
        finally:
            os.close(lock)


def _belongs(process: psutil.Process, folder: str) -> bool:
    try:
        if process.pid == os.getpid() or process.uids().real != os.getuid():
            return False
        # Each sign is missing somewhere: a process that changes its title may overwrite the others.
        options = [word for word in process.cmdline() if word.startswith("--")]
        files = [file.path for file in process.open_files()]
        return process.environ().get(OWNER) == folder or any(folder in text for text in [*options, *files])
    except psutil.Error:
        return False
