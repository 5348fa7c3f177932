"""`datagen cancel`: ask the jobs of a run to stop, and wait until they have ended."""

from __future__ import annotations

import sys
import time
from typing import Annotated

from cyclopts import Parameter

from datagen.cluster.ray_head import head_token, running_head, stop_head
from datagen.cluster.ray_jobs import open_ray_jobs
from datagen.console.command_lines import command_line, resume_with
from datagen.console.options import AsJson
from datagen.console.printing import counted, print_json, print_rows, seconds
from datagen.jobs.job_report import health_line, job_report
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Jobs, StoredJob
from datagen.schemas.run import open_runs
from datagen.schemas.storage import open_storage

_POLL_S = 1.0
# A driver polls for stop requests every few seconds; a detached one that is slower counts as unresponsive.
_ANSWER_WITHIN_S = 30.0
# Longer than a working driver is silent: without worker processes it polls only between two shards.
_GIVE_UP_S = 180.0


def cancel(
    run: Annotated[str | None, Parameter(name="RUN")] = None,
    /,
    *,
    now: bool = False,
    head: bool = False,
    json: AsJson = False,
) -> int:
    """Ask every job of a run to stop, and wait until it has. Committed shards are kept.

    Jobs on other machines are asked in the same way. A detached job whose driver does not answer is stopped
    through Ray. Waiting ends after 3 minutes without a sign of a job, or with Ctrl-C; the request stays
    in force. Exit code 0 when every job has ended, 1 when one has not.

    For example: datagen cancel runs/first

    Args:
        run: Folder or s3:// address of a run or of merged runs.
        now: Kill the running attempts instead of letting them commit.
        head: Stop the Ray head of this machine that runs detached jobs.
    """
    if head:
        if run is not None:
            problem = "--head concerns this machine and not a run"
            raise InputError("datagen cancel", run, problem, "Give one of the two")
        return _cancel_head(now, json)
    if run is None:
        raise InputError("datagen cancel", "RUN", "is missing", "Name a run, or give --head")
    storage = open_storage(run, probe=False, create=False)
    open_runs(storage)  # InputError where there is no run
    jobs = Jobs(storage)
    running = [job for job in jobs.all() if job.health() in ("live", "silent")]
    for job in running:
        jobs.ask_to_stop(job.id, now)
    ended = [_await_end(jobs, job) for job in running]
    unfinished = [job for job in ended if job.health() not in ("ended", "dead")]
    if json:
        print_json({"run": storage.url, "jobs": [job_report(job) for job in ended]})
    elif not ended:
        print_rows(f"cancel {run}", [("jobs", "none is running")])
    else:
        print_rows(f"cancel {run}", [(job.id, health_line(job)) for job in ended])
        if not unfinished:
            sys.stdout.write(f"{resume_with(['resume', run])}\n")
    for job in unfinished:
        _print_stderr(
            f"{run}: job {job.id} was asked to stop and has not ended; its last sign was "
            f"{seconds(job.silence().total_seconds())} ago. To end it by force: "
            f"kill -9 {job.record.pid} on {job.record.host}, then {command_line(['resume', run])}"
        )
    return 1 if unfinished else 0


def _await_end(jobs: Jobs, job: StoredJob) -> StoredJob:
    """Return the job once it has ended, is dead, or does not answer."""
    since_s, printed, stopped = time.monotonic(), "", False
    while True:
        job = jobs.get(job.id) or job
        health, waited_s = job.health(), time.monotonic() - since_s
        if health in ("ended", "dead"):
            return job
        if job.record.submission and not stopped and waited_s >= _ANSWER_WITHIN_S and not _answers(job):
            _stop_submission(job)
            stopped = True
        if health == "silent" and not job.record.submission:
            return job
        if waited_s >= _GIVE_UP_S <= job.silence().total_seconds():
            return job
        if stopped and waited_s >= 2 * _ANSWER_WITHIN_S:
            return job
        line = health_line(job)
        if line.partition(", heard")[0] != printed.partition(", heard")[0]:
            _print_stderr(f"{job.id}: {line}")
            printed = line
        time.sleep(_POLL_S)


def _answers(job: StoredJob) -> bool:
    return job.state is not None and (bool(job.state.stopping) or job.state.phase == "sealing")


def _stop_submission(job: StoredJob) -> None:
    """Stop a detached job through Ray; where Ray has ended, so has the job."""
    try:
        open_ray_jobs(job.record.jobs_api, head_token(job.record.jobs_api)).stop(job.record.submission)
    except InputError as error:
        _print_stderr(f"{job.id}: {error}")


def _cancel_head(now: bool, json: bool) -> int:
    head = running_head()
    if head is not None and not now:
        working = open_ray_jobs(head.jobs_api, head.token).at_work()
        if working:
            fix = "Cancel them first, or give --now to kill them"
            raise InputError(
                "--head", "", f"{counted(len(working), 'job')} running, first {working[0][:200]}", fix
            )
    began_s = time.monotonic()
    ended = stop_head()
    if json:
        print_json({"stopped": ended})
        return 0
    outcome = f"stopped after {seconds(time.monotonic() - began_s)}" if ended else "none runs for this user"
    print_rows("Ray for detached jobs", [("head", outcome)])
    return 0


def _print_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
