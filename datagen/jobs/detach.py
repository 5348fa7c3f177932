"""Run a command in a process of its own, which continues after the shell has ended."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from datagen.cluster.ray_settings import import_root
from datagen.console.command_lines import command_line
from datagen.jobs.job_report import JobResult
from datagen.schemas.errors import InputError

_BEGUN_WITHIN_S = 2.0


def detach_job(words: Sequence[str], path: str) -> JobResult:
    """Run the command of these words in the background, and return how to follow and stop it.

    Its output is in a file below the system's folder for temporary files. InputError where it ends at once.
    """
    handle, name = tempfile.mkstemp(prefix="datagen-", suffix=".log")
    with open(handle, "wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "datagen.cli", *words],
            cwd=import_root(),  # the paths in its words are absolute
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    with suppress(subprocess.TimeoutExpired):
        if process.wait(_BEGUN_WITHIN_S):
            lines = Path(name).read_text(errors="replace").strip().splitlines()
            why = lines[-1].removeprefix("error: ") if lines else f"exit code {process.returncode}"
            raise InputError(path, "", f"ended at once: {why}", "Correct the command and submit again")
    rows = [
        ("process", f"{process.pid} on {os.uname().nodename}"),
        ("output", name),
        ("follow", command_line(["status", path])),
        ("stop", command_line(["cancel", path])),
    ]
    return JobResult(path, "detached", resume=tuple(words), follow=tuple(rows))
