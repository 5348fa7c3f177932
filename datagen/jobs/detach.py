"""A command handed over to Ray: it goes on there when the shell that gave it has ended."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from datagen.cluster.environment import JOB_ENVIRONMENT, is_of_the_shell
from datagen.cluster.private_folder import write_private
from datagen.cluster.ray_head import ensure_head, head_token
from datagen.cluster.ray_jobs import ENDED, RayJobs, open_ray_jobs
from datagen.console.command_lines import command_line
from datagen.console.printing import print_rows
from datagen.jobs.options import JOBS_API, SUBMISSION, Placing
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import new_job_id

_BEGUN_WITHIN_S = 60.0
_LOOK_S = 0.3


def detach_job(words: Sequence[str], place: str, placing: Placing) -> int:
    """Let the command of these words run as a Ray job, and say how to follow it.

    With the address `local`, on a head of this machine that is started where none runs. Comes back once
    the command has begun, or waits for room on its cluster. InputError where the cluster cannot be
    reached or refuses it.
    """
    submission = f"datagen-{new_job_id()}"
    address = [] if placing.workers == 0 else ["--address", "auto"]
    if placing.address == "local":
        head = ensure_head(placing.workers or len(os.sched_getaffinity(0)))
        jobs = open_ray_jobs(head.jobs_api, head.token)
        # The very program that was called: the head runs on its machine, for its user.
        entrypoint = shlex.join([sys.executable, "-m", "datagen.cli", *words, *address])
        file = hand_over(jobs, Path(head.folder), submission)
        environment = {SUBMISSION: submission, JOBS_API: jobs.url, JOB_ENVIRONMENT: str(file)}
    else:
        jobs = open_ray_jobs(placing.address)
        entrypoint = shlex.join(["datagen", *words, *address])  # as the cluster's image has it
        environment = {SUBMISSION: submission, JOBS_API: jobs.url}
    jobs.submit(entrypoint, submission, environment)
    state = _await_begin(jobs, submission)
    rows = [
        ("submission", submission),
        ("state", state.lower()),
        ("cluster", jobs.url),
        ("follow", command_line(["status", place])),
        ("", command_line(["logs", place, "--follow"])),
        ("stop", command_line(["cancel", place])),
    ]
    if placing.address == "local":
        rows.append(("Ray stays", f"for later jobs; {command_line(['cancel', '--head'])} ends it"))
    print_rows(f"detached: {command_line(words)}", rows)
    return 0


def hand_over(jobs: RayJobs, folder: Path, submission: str) -> Path:
    """Write what this shell says of stores and caches for one job; return the file.

    The job removes it at its end. Those of jobs that were killed are removed here.
    """
    for left in folder.glob("datagen-*.json"):
        if jobs.state(left.stem) in ENDED:
            left.unlink(missing_ok=True)
    file = folder / f"{submission}.json"
    own = (SUBMISSION, JOBS_API, JOB_ENVIRONMENT)  # where this shell is itself a detached job
    given = {n: value for n, value in os.environ.items() if is_of_the_shell(n) and n not in own}
    write_private(file, json.dumps(given))
    return file


def detached_words() -> list[str]:
    """In a detached job, the options with which its command would be handed over in the same way again."""
    jobs_api = os.environ.get(JOBS_API, "")
    if not jobs_api:
        return []
    return ["--detach"] if head_token(jobs_api) else ["--detach", "--address", jobs_api]


def _await_begin(jobs: RayJobs, submission: str) -> str:
    until_s = time.monotonic() + _BEGUN_WITHIN_S
    while True:
        state = jobs.state(submission)
        if state in ("FAILED", "STOPPED"):
            said = jobs.output(submission).strip().splitlines()
            why = said[-1].removeprefix("error: ") if said else jobs.message(submission)
            raise InputError(submission, "", f"it ended at once: {why}", "Correct it and submit again")
        if state != "PENDING" or time.monotonic() >= until_s:
            return state
        time.sleep(_LOOK_S)


def jobs_api_of(url: str) -> RayJobs:
    """The Jobs API where a detached job was handed over. InputError where it does not answer."""
    return open_ray_jobs(url, head_token(url))
