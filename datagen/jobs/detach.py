"""Run a command as a Ray job, which continues after the shell has ended."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from datagen.cluster.cluster_folders import write_private
from datagen.cluster.job_monitor import JOBS_API, SUBMISSION
from datagen.cluster.ray_head import ensure_head
from datagen.cluster.ray_jobs import ENDED, RayJobs, open_ray_jobs
from datagen.cluster.ray_settings import JOB_ENVIRONMENT, is_of_the_shell
from datagen.console.command_lines import command_line
from datagen.jobs.job import JobOptions
from datagen.jobs.job_report import JobResult
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import new_job_id

_BEGUN_WITHIN_S = 60.0
_POLL_S = 0.3

Options = TypeVar("Options", bound=JobOptions)


def detach_job(words: Sequence[str], path: str, job_options: JobOptions) -> JobResult:
    """Run the command of these words as a Ray job, and return how to follow it.

    With the address `local`, it runs on a Ray head of this machine, which is started if needed. Returns once
    the command has begun or is queued. InputError where the cluster cannot be reached or refuses the job.
    """
    submission = f"datagen-{new_job_id()}"
    if job_options.address == "local":
        head = ensure_head(job_options.workers or len(os.sched_getaffinity(0)))
        jobs = open_ray_jobs(head.jobs_api, head.token)
        # The program that was called: the head runs on this machine, as this user.
        entrypoint = shlex.join([sys.executable, "-m", "datagen.cli", *words])
        file = hand_over(jobs, Path(head.folder), submission)
        environment = {SUBMISSION: submission, JOBS_API: jobs.url, JOB_ENVIRONMENT: str(file)}
    else:
        jobs = open_ray_jobs(job_options.address)
        entrypoint = shlex.join(["datagen", *words])  # as installed on the cluster
        environment = {SUBMISSION: submission, JOBS_API: jobs.url}
    jobs.submit(entrypoint, submission, environment)
    state = _await_begin(jobs, submission)
    rows = [
        ("submission", submission),
        ("state", state.lower()),
        ("cluster", jobs.url),
        ("follow", command_line(["status", path])),
        ("stop", command_line(["cancel", path])),
    ]
    if job_options.address == "local":
        rows.append(("Ray", f"keeps running for later jobs; stop it: {command_line(['cancel', '--head'])}"))
    return JobResult(path, "detached", resume=tuple(words), follow=tuple(rows))


def in_ray_job(options: Options) -> Options:
    """The options with which a Ray job runs a command that was detached with these."""
    return replace(options, detach=False, address="auto")


def hand_over(jobs: RayJobs, folder: Path, submission: str) -> Path:
    """Write the shell's variables to a file, which the job removes; remove the files of killed jobs."""
    for left in folder.glob("datagen-*.json"):
        if jobs.state(left.stem) in ENDED:
            left.unlink(missing_ok=True)
    file = folder / f"{submission}.json"
    own = (SUBMISSION, JOBS_API, JOB_ENVIRONMENT)  # set where this process is itself a detached job
    given = {n: value for n, value in os.environ.items() if is_of_the_shell(n) and n not in own}
    write_private(file, json.dumps(given))
    return file


def _await_begin(jobs: RayJobs, submission: str) -> str:
    until_s = time.monotonic() + _BEGUN_WITHIN_S
    while True:
        state = jobs.state(submission)
        if state in ("FAILED", "STOPPED"):
            output = jobs.output(submission).strip().splitlines()
            why = output[-1].removeprefix("error: ") if output else jobs.message(submission)
            raise InputError(submission, "", f"ended at once: {why}", "Correct the command and submit again")
        if state != "PENDING" or time.monotonic() >= until_s:
            return state
        time.sleep(_POLL_S)
