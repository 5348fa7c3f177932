"""A Ray head of this machine for detached jobs: it outlives the shell, listens on loopback, asks for a token.

One for each user, known by a file in the user's state folder that others cannot read.
"""

from __future__ import annotations

import fcntl
import http.client
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import psutil
from pydantic import Field, ValidationError

from cluster.ray_settings import head_arguments, head_environment, new_token
from schemas.errors import InputError
from schemas.run_records import StoredRecord

_START_WITHIN_S = 120.0
_STOP_WITHIN_S = 4.0  # politely; some of Ray's processes do not heed that
_ANSWER_WITHIN_S = 10.0
_URL = re.compile(r"http://127\.0\.0\.1:[0-9]{1,5}")
_MAX_BYTES = 1 << 16


class Head(StoredRecord):
    """head.json in the state folder: the head that this user's detached jobs go to."""

    jobs_api: str = Field(pattern=r"^http://127\.0\.0\.1:[0-9]{1,5}$")
    token: str = Field(pattern=r"^[0-9a-f]{64}$")
    group: int = Field(gt=1)  # process group of its processes
    folder: str  # its sockets and logs


def state_folder() -> Path:
    """Where this user's programs keep what outlives them: DATAGEN_STATE, else the system's place for it."""
    if named := os.environ.get("DATAGEN_STATE"):
        return Path(named).expanduser().absolute()
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "datagen"


def running_head() -> Head | None:
    """The head that answers on this machine; None where none does."""
    head = _read()
    return head if head is not None and _answers(head) else None


def ensure_head(workers: int) -> Head:
    """The head of this machine, started with this many slots where none runs. InputError where it fails."""
    with _locked():
        head = running_head()
        if head is None:
            if (stale := _read()) is not None:
                _end(stale)  # it does not answer: what is left of it would keep its cores busy
            head = _start(workers)
        return head


def stop_head() -> bool:
    """End the head and all that runs on it; False where there is none."""
    with _locked():
        head = _read()
        if head is None:
            return False
        _end(head)
        return True


def head_token(jobs_api: str) -> str:
    """The token for the Jobs API at this address, where it is our head's; "" for others."""
    head = _read()
    return head.token if head is not None and head.jobs_api == jobs_api else ""


@contextmanager
def _locked() -> Generator[None]:
    folder = state_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        file = (folder / "head.lock").open("w")
    except OSError as error:
        mend = "Name a folder of your own as DATAGEN_STATE"
        raise InputError(folder, "", f"cannot be written: {error.strerror}", mend) from error
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)  # two shells must not start two heads
        yield


def _read() -> Head | None:
    try:
        with (state_folder() / "head.json").open("rb") as file:
            return Head.model_validate_json(file.read(_MAX_BYTES))
    except (OSError, ValidationError):
        return None  # lost or broken: then the next job starts a head of its own


def _start(workers: int) -> Head:
    # Ray opens its own folder to everybody, so it lies in one that is closed. Sockets need a short path.
    folder = Path(tempfile.mkdtemp(prefix="datagen-head-", dir="/tmp"))
    token, said = new_token(), folder / "start.txt"
    inherited = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    arguments = [*head_arguments(max(1, workers)), f"--temp-dir={folder / 'ray'}"]
    with said.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "ray.scripts.scripts", *arguments],
            env=inherited | head_environment(token),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # the end of the shell is not its end
        )
        try:
            code = process.wait(_START_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
    text = said.read_text(errors="replace")
    found = _URL.search(text)
    if code != 0 or found is None:
        _end_group(process.pid)
        problem = next((line for line in reversed(text.splitlines()) if line.strip()), "it said nothing")
        raise InputError("ray", "", f"does not start: {problem}", f"See {said}")
    head = Head(jobs_api=found[0], token=token, group=process.pid, folder=str(folder))
    path = state_folder() / "head.json"
    draft = path.with_suffix(f".{os.getpid()}.part")
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(head.model_dump_json())
    draft.replace(path)
    return head


def _answers(head: Head) -> bool:
    port = urlsplit(head.jobs_api).port
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_ANSWER_WITHIN_S)
    try:
        connection.request("GET", "/api/version", headers={"Authorization": f"Bearer {head.token}"})
        return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def _end(head: Head) -> None:
    folder = Path(head.folder)
    # The number of a group that is gone may be another's by now.
    if any(head.folder in " ".join(_command(p)) for p in _members(head.group)):
        _end_group(head.group)
    # Workers that were just starting belong to nobody now.
    _end_all({p for p in _own() if head.folder in " ".join(_command(p))})
    (state_folder() / "head.json").unlink(missing_ok=True)
    if folder.name.startswith("datagen-head-") and folder.parent == Path("/tmp"):
        shutil.rmtree(folder, ignore_errors=True)


def _end_group(group: int) -> None:
    members = _members(group)
    # Workers and jobs have groups of their own; they are children of this one's processes.
    _end_all({*members, *(child for p in members for child in _children(p))})


def _end_all(processes: set[psutil.Process]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        for process in processes:
            try:
                process.send_signal(number)
            except psutil.NoSuchProcess:
                continue
        _, living = psutil.wait_procs(list(processes), timeout=_STOP_WITHIN_S)
        processes = set(living)


def _members(group: int) -> list[psutil.Process]:
    found: list[psutil.Process] = []
    for process in _own():
        try:
            if os.getpgid(process.pid) == group:
                found.append(process)
        except (ProcessLookupError, PermissionError):
            continue
    return found


def _own() -> list[psutil.Process]:
    """Processes of this user, without the one that asks."""
    found: list[psutil.Process] = []
    for process in psutil.process_iter():
        try:
            if process.pid != os.getpid() and process.uids().real == os.getuid():
                found.append(process)
        except psutil.Error:
            continue
    return found


def _children(process: psutil.Process) -> list[psutil.Process]:
    try:
        return process.children(recursive=True)
    except psutil.Error:
        return []


def _command(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []
