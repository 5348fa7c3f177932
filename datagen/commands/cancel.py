"""`datagen cancel`: ask the jobs of a run to stop, and wait until they have ended."""

from __future__ import annotations

import sys
import time

from datagen.console.command_lines import command_line, resume_with
from datagen.console.options import AsJson, RunPath
from datagen.console.printing import print_json, print_rows, seconds
from datagen.jobs.job_report import health_line, job_report
from datagen.schemas.jobs import Jobs, StoredJob
from datagen.schemas.run import open_runs
from datagen.schemas.storage import open_storage

_POLL_S = 1.0
# Longer than a working driver is silent: without worker processes it polls only between two shards.
_GIVE_UP_S = 180.0


def cancel(run: RunPath, /, *, now: bool = False, json: AsJson = False) -> int:
    """Ask every job of a run to stop, and wait until it has. Committed shards are kept.

    Jobs on other machines are asked in the same way. Waiting ends after 3 minutes without a sign of a job, or
    with Ctrl-C; the request stays in force. Exit code 0 when every job has ended, 1 when one has not.

    For example: datagen cancel runs/first

    Args:
        now: Kill the running attempts instead of letting them commit.
    """
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
    since_s, printed = time.monotonic(), ""
    while True:
        job = jobs.get(job.id) or job
        health, waited_s = job.health(), time.monotonic() - since_s
        if health in ("ended", "dead", "silent"):
            return job
        if waited_s >= _GIVE_UP_S <= job.silence().total_seconds():
            return job
        line = health_line(job)
        if line.partition(", last sign")[0] != printed.partition(", last sign")[0]:
            _print_stderr(f"{job.id}: {line}")
            printed = line
        time.sleep(_POLL_S)


def _print_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
