"""The Ray head of this machine for detached jobs: it outlives the shell, and is private to the user.

It listens on loopback and requires a token. There is one per user, recorded in a private file in the user's
state folder.
"""

from __future__ import annotations

import fcntl
import os
import re
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from pydantic import Field, ValidationError

from datagen.cluster.cluster_folders import RAY, new_folder, remove_folder, write_private
from datagen.cluster.ray_jobs import dashboard_status
from datagen.cluster.ray_settings import head_arguments, head_environment, is_of_the_shell, new_token
from datagen.schemas.errors import InputError
from datagen.schemas.run_records import StoredRecord
from datagen.schemas.safe_files import is_private

_START_WITHIN_S = 300.0
_KIND = "datagen-head-"
_URL = re.compile(r"http://127\.0\.0\.1:[0-9]{1,5}")
_MAX_BYTES = 1 << 16


class Head(StoredRecord):
    """head.json in the state folder: the Ray head of this user's detached jobs."""

    jobs_api: str = Field(pattern=r"^http://127\.0\.0\.1:[0-9]{1,5}$")
    token: str = Field(pattern=r"^[0-9a-f]{64}$")
    group: int = Field(gt=1)  # process group of its processes
    folder: str  # its sockets and logs


def state_folder() -> Path:
    """The user's state folder: DATAGEN_STATE, else the default of the system."""
    if named := os.environ.get("DATAGEN_STATE"):
        return Path(named).expanduser().absolute()
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "datagen"


def running_head() -> Head | None:
    """The running head of this machine; else None."""
    head = _read()
    return head if head is not None and dashboard_status(head.jobs_api, head.token) == 200 else None


def ensure_head(workers: int) -> Head:
    """The head of this machine, started with this many slots where none runs. InputError on failure."""
    with _locked():
        head = running_head()
        if head is None:
            if (stale := _read()) is not None:
                _end(stale)  # it does not respond: its remaining processes would keep cores busy
            head = _start(workers)
        return head


def stop_head() -> bool:
    """Stop the head and all its jobs; False where there is none."""
    with _locked():
        head = _read()
        if head is None:
            return False
        _end(head)
        return True


def head_token(jobs_api: str) -> str:
    """The token of the Jobs API at this address where it is this user's head; "" for others."""
    head = _read()
    return head.token if head is not None and head.jobs_api == jobs_api else ""


@contextmanager
def _locked() -> Generator[None]:
    folder = state_folder()
    fix = "Set DATAGEN_STATE to a folder of your own, of mode 0700"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not is_private(folder.stat()):
            raise InputError(folder, "", "belongs to another user, or other users can write to it", fix)
        file = (folder / "head.lock").open("w")
    except OSError as error:
        raise InputError(folder, "", f"cannot be written: {error.strerror}", fix) from error
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)  # two shells must not start two heads
        yield


def _read() -> Head | None:
    try:
        with (state_folder() / "head.json").open("rb") as file:
            if not is_private(os.fstat(file.fileno())):
                return None  # another user's file: following it would run that user's code
            return Head.model_validate_json(file.read(_MAX_BYTES))
    except (OSError, ValidationError):
        return None  # missing or damaged: the next job starts a new head


def _start(workers: int) -> Head:
    until_s = time.monotonic() + _START_WITHIN_S
    while True:
        folder = new_folder(_KIND)
        try:
            head = _started(workers, folder, until_s)
        except BaseException:
            remove_folder(folder)
            raise
        if isinstance(head, Head):
            write_private(state_folder() / "head.json", head.model_dump_json())
            return head
        remove_folder(folder)
        # Ray's own timeouts of 15 to 30 s are too short for a busy machine.
        if time.monotonic() >= until_s:
            fix = "Submit again when the machine is less busy, or without --detach"
            raise InputError("ray", "", f"does not start: {head}", fix)
        sys.stderr.write(f"Ray did not start; trying again: {head}\n")


def _started(workers: int, folder: Path, until_s: float) -> Head | str:
    """Start the head in this private folder; return it, or its last message where it failed."""
    token, output = new_token(), folder / "start.txt"
    # Jobs bring their own store settings: no job may use the credentials of another.
    inherited = {n: value for n, value in os.environ.items() if n != "RAY_ADDRESS" and not is_of_the_shell(n)}
    arguments = [*head_arguments(max(1, workers)), f"--temp-dir={folder / RAY}"]
    with output.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "ray.scripts.scripts", *arguments],
            env=inherited | head_environment(token, folder),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # it outlives the shell
        )
        try:
            code = process.wait(max(0.0, until_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
    text = output.read_text(errors="replace")
    found = _URL.search(text)
    if code != 0 or found is None:
        return next((line for line in reversed(text.splitlines()) if line.strip()), "no output")
    return Head(jobs_api=found[0], token=token, group=process.pid, folder=str(folder))


def _end(head: Head) -> None:
    (state_folder() / "head.json").unlink(missing_ok=True)
    folder = Path(head.folder)
    if folder.name.startswith(_KIND) and folder.parent == Path("/tmp"):
        remove_folder(folder)
