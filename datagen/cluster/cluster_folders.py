"""Private folders of this user below /tmp, and the processes that belong to them.

Ray makes its own folders accessible to all users, so each local cluster has its folder inside a private one.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from datagen.schemas.safe_files import locked_folder

_PARENT = Path("/tmp")  # sockets need a short path
_KIND = "datagen-ray-"
_STOP_WITHIN_S = 4.0  # after SIGTERM, which some of Ray's processes ignore
_KILL_WITHIN_S = 60.0  # after SIGKILL, on a busy machine

# Variable with the folder in each of its processes; Ray reads it too.
OWNER = "RAY_TMPDIR"
RAY = "ray"  # the subfolder that Ray writes to


@contextmanager
def private_folder() -> Generator[Path]:
    """Give a new folder of mode 0700; when the block ends, its processes are killed and it is removed.

    First removes folders of killed programs of this user.
    """
    with locked_folder(_KIND, _PARENT, remove_folder) as folder:
        (folder / RAY).mkdir()
        yield folder


def remove_folder(folder: Path) -> None:
    """End every process of this user that belongs to a private folder, and remove it."""
    end_processes([p for p in psutil.process_iter() if _belongs(p, str(folder))])
    shutil.rmtree(folder, ignore_errors=True)


def end_processes(processes: list[psutil.Process]) -> None:
    """Send SIGTERM and, some seconds later, SIGKILL to the remaining processes; wait until all have ended."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        for process in processes:
            with suppress(psutil.Error):
                process.send_signal(number)
        _, processes = psutil.wait_procs(processes, timeout=_STOP_WITHIN_S)
    psutil.wait_procs([process for process in processes if is_alive(process)], timeout=_KILL_WITHIN_S)


def is_alive(process: psutil.Process) -> bool:
    """Whether a process still has memory, which the kernel frees first when it ends."""
    try:
        return process.is_running() and process.memory_info().vms > 0
    except psutil.NoSuchProcess:
        return False


def _belongs(process: psutil.Process, folder: str) -> bool:
    try:
        if process.pid == os.getpid() or process.uids().real != os.getuid():
            return False
        # A process that changes its title may overwrite either of these signs, so both are checked.
        options = [word for word in process.cmdline() if word.startswith("--")]
        files = [file.path for file in process.open_files()]
        return process.environ().get(OWNER) == folder or any(folder in text for text in [*options, *files])
    except psutil.Error:
        return False
