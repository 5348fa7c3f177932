"""`datagen cancel`: ask the jobs of a run to stop, and wait for their end."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Annotated

from cyclopts import Parameter

from datagen.cluster.ray_head import running_head, stop_head
from datagen.cluster.ray_jobs import open_ray_jobs
from datagen.console.command_lines import command_line, continue_with
from datagen.console.options import AsJson
from datagen.console.printing import counted, print_json, print_rows, seconds
from datagen.jobs.detach import jobs_api_of
from datagen.jobs.report import health_line, job_report
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Job, Jobs
from datagen.schemas.merged import open_runs
from datagen.schemas.storage import open_storage

_LOOK_S = 1.0
# Its driver looks for requests every few seconds; beyond this one of a detached job has not answered.
_ANSWER_WITHIN_S = 30.0
# Longer than a driver is silent that works; one without workers of its own hears between two shards.
_GIVE_UP_S = 180.0


def cancel(
    run: Annotated[
        str | None, Parameter(help="The run's folder or s3:// address; also of merged runs.")
    ] = None,
    *,
    now: Annotated[
        bool, Parameter(negative=(), help="End what is in flight by force, instead of letting it commit.")
    ] = False,
    head: Annotated[
        bool, Parameter(negative=(), help="End the Ray that stays on this machine for detached jobs.")
    ] = False,
    json: AsJson = False,
) -> int:
    """Ask every job at work on a run to stop, and wait until it has: what is committed stays.

    A job on another machine is asked in the same way. Detached jobs whose driver does not answer are
    ended through Ray. A job that is not heard for 3 minutes is waited for no longer. Ctrl-C ends the
    waiting. Either way the request stands. Exit code: 0 when every job has ended, 1 when one has not.
    """
    if head:
        if run is not None:
            problem = "--head is of this machine, and not of a run"
            raise InputError("datagen cancel", run, problem, "Give one of the two")
        return _cancel_head(now)
    if run is None:
        raise InputError("datagen cancel", "RUN", "no run is named", "Name one, or give --head")
    place = open_storage(run, probe=False, create=False)
    open_runs(place)  # refuses what is none
    jobs = Jobs(place)
    asked = [job for job in jobs.all() if job.health() in ("live", "silent")]
    for job in asked:
        jobs.ask_to_stop(job.id, now)
    ended = [_await_end(jobs, job, _say) for job in asked]
    living = [job for job in ended if job.health() not in ("ended", "dead")]
    if json:
        print_json({"run": place.url, "jobs": [job_report(job) for job in ended]})
    elif not ended:
        print_rows(f"cancel {run}", [("jobs", "none is at work")])
    else:
        print_rows(f"cancel {run}", [(job.id, health_line(job)) for job in ended])
        if not living:
            sys.stdout.write(f"{continue_with(['resume', run])}\n")
    for job in living:
        _say(
            f"{run}: job {job.id} was asked to stop and has not ended, heard "
            f"{seconds(job.silence().total_seconds())} ago. The request stands; to end the job by force: "
            f"kill -9 {job.record.pid} on {job.record.host}, then {command_line(['resume', run])}"
        )
    return 1 if living else 0


def _await_end(jobs: Jobs, job: Job, say: Callable[[str], None]) -> Job:
    """The job when it has ended, is dead, or does not answer."""
    since_s, told, stopped = time.monotonic(), "", False
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
        if line.partition(", heard")[0] != told.partition(", heard")[0]:
            say(f"{job.id}: {line}")
            told = line
        time.sleep(_LOOK_S)


def _answers(job: Job) -> bool:
    return job.state is not None and (bool(job.state.stopping) or job.state.phase == "sealing")


def _stop_submission(job: Job) -> None:
    """End a detached job through Ray; where Ray is gone too, so is the job."""
    try:
        jobs_api_of(job.record.jobs_api).stop(job.record.submission)
    except InputError as error:
        _say(f"{job.id}: {error}")


def _cancel_head(now: bool) -> int:
    head = running_head()
    if head is not None and not now:
        working = open_ray_jobs(head.jobs_api, head.token).at_work()
        if working:
            mend = "Cancel them first, or give --now to end them by force"
            raise InputError(
                "--head", "", f"at work: {counted(len(working), 'job')}, first {working[0][:200]}", mend
            )
    began_s = time.monotonic()
    ended = stop_head()
    said = f"ended after {seconds(time.monotonic() - began_s)}" if ended else "none runs for this user"
    print_rows("Ray for detached jobs", [("head", said)])
    return 0


def _say(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
