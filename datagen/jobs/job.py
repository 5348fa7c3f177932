"""A job: make the missing shards on this machine or a cluster, publish its status, print a summary."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

from datagen.cluster.attempt import run_attempt
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.executor import Executor
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.job_monitor import JobMonitor
from datagen.cluster.job_totals import JobSummary, JobTotals, empty_summary
from datagen.cluster.post_mortem import notes_of_a_job
from datagen.cluster.preflight import refuse_unfit_machines
from datagen.cluster.progress import JobProgress
from datagen.cluster.ray_cluster import RaySettings
from datagen.cluster.ray_executor import RayExecutor, ray_executor
from datagen.cluster.retry_policy import RetryPolicy, too_many_quarantined
from datagen.cluster.run_recorder import RunRecorder, close_lost_attempts
from datagen.cluster.stop_request import StopRequest, stop_on_signals
from datagen.cluster.task import ShardTask
from datagen.console.command_lines import command_line, say_interrupted
from datagen.console.printing import counted, listed, print_rows, seconds
from datagen.jobs.job_recorder import JobRecorder
from datagen.jobs.options import JobOptions
from datagen.reports.specification_summary import made_from
from datagen.schemas.errors import InputError, one_line
from datagen.schemas.jobs import JobEnd, JobRecord, Jobs, new_job_id
from datagen.schemas.progress import Progress
from datagen.schemas.record_files import utc_now
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage

# Set for the driver of a detached job: its name at the Jobs API, and the address of that.
SUBMISSION, JOBS_API = "DATAGEN_SUBMISSION", "DATAGEN_JOBS_API"


@dataclass(frozen=True, eq=False)
class JobRun:
    """One run of a job, and its sources."""

    run: Run
    houses: str  # source references, absolute
    objects: str
    scenes_from: str = ""  # the run whose scenes are labelled again; "" for new scenes


@dataclass(frozen=True, eq=False)
class JobPlan:
    """The work of a job: the missing shards of one run, or of the parts of merged runs."""

    storage: Storage  # where the job's records and the sealed store go
    path: str  # as the user wrote it
    runs: Sequence[JobRun]
    options: JobOptions
    began_s: float  # by the monotonic clock, when the command began to open them
    resume: Sequence[str]  # the words of the command that goes on with it


def run_job(plan: JobPlan) -> int:
    """Make every missing shard, seal, and print a summary; return the exit code.

    While it works, the job is known there, and handles requests to stop that are left there.
    """
    if not _count_missing(plan):
        for job_run in plan.runs:
            close_lost_attempts(job_run.run)
        return _finish(plan, _judged(plan, empty_summary()))
    recorder = open_recorder(plan)
    try:
        summary = _judged(plan, make_missing(plan, recorder))
        recorder.seal()
        code = _finish(plan, summary)
    except BaseException as error:
        end, code = _end_of(error)
        recorder.end(end, code, " ".join(str(error).split())[:1000])
        raise
    recorder.end(summary.end, code, summary.cause, summary)
    return code


def _end_of(error: BaseException) -> tuple[JobEnd, int]:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", 130
    if isinstance(error, _CannotContinue):
        return "aborted", 2
    return "broken", 2 if isinstance(error, InputError) else 1


def open_recorder(plan: JobPlan) -> JobRecorder:
    """Publish the job's record."""
    record = JobRecord(
        id=new_job_id(),
        command=("datagen", *sys.argv[1:]),
        host=platform.node(),
        pid=os.getpid(),
        started=utc_now(),
        address=plan.options.address,
        submission=os.environ.get(SUBMISSION, ""),
        jobs_api=os.environ.get(JOBS_API, ""),
    )
    recorder = JobRecorder(Jobs(plan.storage), record, _count_missing(plan))
    recorder.begin()
    return recorder


def _count_missing(plan: JobPlan) -> int:
    return sum(len(job_run.run.missing()) for job_run in plan.runs)


def make_missing(plan: JobPlan, recorder: JobRecorder) -> JobSummary:
    """Drive one run after the other on one set of workers; return the summary."""
    missing = [job_run.run.missing() for job_run in plan.runs]
    job_options, stop = plan.options, StopRequest()
    policy = RetryPolicy(max_quarantined_share=job_options.max_quarantined)
    whole = empty_summary()
    with ExitStack() as stack:
        notes = stack.enter_context(notes_of_a_job())
        shown = stack.enter_context(Progress(job_options.json))
        executor = _executor(job_options, sum(map(len, missing)), stack, shown)
        stack.enter_context(stop_on_signals(stop, interrupt=job_options.workers == 0))
        for job_run, shards in zip(plan.runs, missing, strict=True):
            if whole.end in ("interrupted", "aborted"):
                whole = replace(whole, totals=whole.totals.plus(JobTotals(len(shards))))
            elif shards:
                whole = whole.plus(_drive(job_run, shards, executor, policy, recorder, stop, shown, notes))
                recorder.add(whole.totals)
        whole = replace(whole, start_s=time.monotonic() - plan.began_s - whole.elapsed_s)
    for job_run in plan.runs:
        # Attempts of killed drivers are closed last: their workers may still commit.
        close_lost_attempts(job_run.run)
    return whole


def _drive(
    job_run: JobRun,
    shards: Sequence[int],
    executor: Executor[ShardTask],
    policy: RetryPolicy,
    recorder: JobRecorder,
    stop: StopRequest,
    shown: Progress,
    notes: str,
) -> JobSummary:
    run = job_run.run
    layout, spec = run.layout, run.manifest.spec

    def make_task(order: AttemptOrder) -> ShardTask:
        return ShardTask(
            run=run.storage.url,
            spec=spec,
            layout=layout,
            shard=order.shard,
            attempt=order.attempt,
            houses=job_run.houses,
            objects=job_run.objects,
            deadline_s=order.deadline_s,
            notes=notes,
            scenes_from=job_run.scenes_from,
        )

    if isinstance(executor, RayExecutor):
        shown.phase("checking the machines")
        probe = make_task(AttemptOrder(shards[0], "probe", deadline_s=0.0))
        refuse_unfit_machines(executor.others.ask, run, probe)
    done, per_shard = len(run.planned()) - len(shards), layout.samples_per_shard
    shown.phase("making labels")
    events = JobMonitor(recorder, stop, per_shard, JobProgress(shown, per_shard, done))
    return drive(shards, make_task, executor, RunRecorder(run), policy, events, stop)


def _judged(plan: JobPlan, summary: JobSummary) -> JobSummary:
    """Decide whether a finished job failed, by the quarantined share of the whole run.

    The driver knows only its own shards, which may be the last two of a thousand.
    """
    if summary.end not in ("complete", "failed") or summary.remaining:
        return summary
    given_up = planned = 0
    for job_run in plan.runs:
        shards = job_run.run.planned()
        planned += len(shards)
        given_up += sum(shard in shards for shard in job_run.run.quarantined())
    policy = RetryPolicy(max_quarantined_share=plan.options.max_quarantined)
    failed = too_many_quarantined(policy, given_up, planned)
    return replace(summary, end="failed" if failed else "complete")


def _executor(job_options: JobOptions, shards: int, stack: ExitStack, shown: Progress) -> Executor[ShardTask]:
    if job_options.workers == 0:
        return InProcessExecutor(run_attempt)
    shown.phase("starting Ray")
    cores = len(os.sched_getaffinity(0))
    workers = min(job_options.workers or cores, shards)  # Ray starts them all at once
    ray_settings = RaySettings(address=job_options.address, workers=workers)
    return stack.enter_context(ray_executor(run_attempt, ray_settings))


class _CannotContinue(InputError):
    """The job met an error that no retry can fix."""


def _finish(plan: JobPlan, summary: JobSummary) -> int:
    """Seal the run, print a summary and how to continue; return the exit code."""
    totals, runs, path = summary.totals, [job_run.run for job_run in plan.runs], plan.path
    n, resume = sum(run.n for run in runs), command_line(plan.resume)
    given_up = [(run, shard) for run in runs for shard in sorted(run.quarantined())]
    if totals.shards:
        labels = f"{totals.labels:,} new of {n:,} wanted"
    elif given_up:
        labels = f"nothing to do: the shards of {n:,} labels are committed or quarantined"
    else:
        labels = f"nothing to do: all {n:,} labels are committed"
    rows = [
        ("labels", labels),
        ("made from", made_from(run.manifest for run in runs)),
        ("positive", f"{100 * totals.positives / totals.labels:.1f}%" if totals.labels else "-"),
        ("time", _time(summary)),
        ("retries", str(totals.retries)),
    ]
    if given_up:
        again = command_line(["resume", path, "--quarantined"])
        those = f"{counted(len(given_up), 'shard')} ({listed([shard for _, shard in given_up])})"
        shown = f"{those}; try again: {again}"
        rows.append(("quarantined", shown))
    if summary.end in ("complete", "failed") and any(run.committed() for run in runs):
        sealed = seal(plan.storage)
        rows.append(("store", f"{sealed}: zarr.open or xarray.open_zarr reads it"))
    print_rows(f"{summary.end}: {path}", rows)
    if summary.end == "aborted":
        raise _CannotContinue(path, "", f"the job cannot continue: {summary.cause}", f"Then resume: {resume}")
    if summary.end == "failed":
        causes = Counter(r.causes[-1] for run in runs for r in run.quarantine_records() if r.causes)
        most = f", most often by: {causes.most_common(1)[0][0]}" if causes else ""
        see = command_line(["status", path])
        sys.stderr.write(one_line(f"error: {path}: too many shards are quarantined{most}. See: {see}") + "\n")
    if summary.end == "interrupted":
        say_interrupted(f"; {counted(summary.remaining, 'shard')} left", plan.resume)
    return summary.exit_code


def _time(summary: JobSummary) -> str:
    if not summary.totals.labels:
        return seconds(summary.start_s + summary.elapsed_s)
    rate = summary.totals.labels / max(summary.elapsed_s, 1e-6)
    parts = f"start {seconds(summary.start_s)}, labels {seconds(summary.elapsed_s)}"
    return f"{seconds(summary.start_s + summary.elapsed_s)}: {parts} at {rate:,.0f}/s"
