"""Environment variables: changed for a block, or passed to a detached job in a file.

Ray shows a runtime environment on command lines and in logs, so secrets are passed in a file that only its
user can read; the job's driver and workers read it when they start.
"""

from __future__ import annotations

import json
import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path

# Path of the file, for a detached job.
JOB_ENVIRONMENT = "DATAGEN_JOB_ENVIRONMENT"
# Name of the thread that disconnects from Ray. Where it is left behind, the interpreter's end would wait too.
ENDING_RAY = "ending Ray"
_OF_THE_SHELL = ("AWS_", "DATAGEN_", "XDG_CACHE_HOME")


def is_of_the_shell(name: str) -> bool:
    """Whether a detached job gets this variable from the submitting shell, not from Ray's head."""
    return name.startswith(_OF_THE_SHELL)


def adopt_job_environment() -> None:
    """Set the variables of a detached job; Ray calls it in each worker of the job."""
    if named := os.environ.get(JOB_ENVIRONMENT):
        os.environ.update(json.loads(Path(named).read_text()))


@contextmanager
def job_environment() -> Generator[None]:
    """Set the variables of a detached job, and remove their file when the block ends."""
    adopt_job_environment()
    try:
        yield
    finally:
        if named := os.environ.get(JOB_ENVIRONMENT):
            Path(named).unlink(missing_ok=True)


@contextmanager
def changed_environment(values: Mapping[str, str | None]) -> Generator[None]:
    """Set variables, or unset those that are None, and restore all when the block ends."""
    before = {name: os.environ.get(name) for name in values}
    _set(values)
    try:
        yield
    finally:
        _set(before)


def _set(values: Mapping[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
