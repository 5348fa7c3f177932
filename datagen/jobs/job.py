"""A job: make the missing shards on this machine or a cluster, publish its status, print a summary."""

from __future__ import annotations

import os
import platform
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace

from datagen.cluster.attempt import run_attempt
from datagen.cluster.budget import BudgetGuard
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.job_progress import JobMonitor, JobProgress, JobStatus, StopMode, TimeLeft
from datagen.cluster.job_totals import End, JobSummary, JobTotals, empty_summary
from datagen.cluster.post_mortem import notes_of_a_job
from datagen.cluster.preflight import refuse_unfit_machines
from datagen.cluster.ray_cluster import RaySettings
from datagen.cluster.ray_executor import RayExecutor, ray_executor
from datagen.cluster.retry_policy import RetryPolicy, too_many_quarantined
from datagen.cluster.run_forecast import RunForecast
from datagen.cluster.run_recorder import RunRecorder, close_lost_attempts
from datagen.cluster.stop_request import StopRequest, stop_on_signals
from datagen.cluster.task import Executor, ShardTask
from datagen.console.command_lines import command_line
from datagen.display.progress import Progress
from datagen.jobs.evidence import made_here
from datagen.jobs.job_report import JobResult
from datagen.jobs.options import JOBS_API, SUBMISSION, JobOptions
from datagen.reports.specification_summary import made_from
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobEnd, JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.record_files import utc_now
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage


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
    command: Sequence[str]  # the words of the command that started it
    resume: Sequence[str]  # the words of the command that resumes it


def run_job(plan: JobPlan) -> JobResult:
    """Make every missing shard, seal, and return the result.

    Meanwhile the job publishes its state in the run, and polls it for stop requests. Raises
    InputError for an error that no retry can fix.
    """
    if not _count_missing(plan):
        for job_run in plan.runs:
            close_lost_attempts(job_run.run)
        return _finish(plan, _judged(plan, empty_summary()))
    recorder = open_recorder(plan)
    try:
        summary = _judged(plan, make_missing(plan, recorder))
        recorder.seal()
        result = _finish(plan, summary)
    except BaseException as error:
        end, code = _end_of(error)
        recorder.end(end, code, " ".join(str(error).split())[:1000])
        raise
    recorder.end(summary.end, result.exit_code, summary.cause, summary)
    return result


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
        command=("datagen", *plan.command),
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
    budget = None if job_options.limit is None else BudgetGuard(job_options.limit, plan.began_s)
    policy = RetryPolicy(max_quarantined_share=job_options.max_quarantined)
    whole = empty_summary()
    with ExitStack() as stack:
        notes = stack.enter_context(notes_of_a_job())
        shown = stack.enter_context(job_options.display())
        executor = _executor(job_options, sum(map(len, missing)), stack, shown)
        stack.enter_context(stop_on_signals(stop, interrupt=job_options.workers == 0))
        for job_run, shards in zip(plan.runs, missing, strict=True):
            if whole.end in ("interrupted", "aborted", "budget"):
                whole = replace(whole, totals=whole.totals.plus(JobTotals(len(shards))))
            elif shards:
                whole = whole.plus(
                    _drive(job_run, shards, executor, policy, recorder, stop, shown, notes, budget)
                )
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
    budget: BudgetGuard | None,
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
    forecast = RunForecast(layout.scenes_per_shard, made_here(run))
    left = TimeLeft(forecast, lambda: executor.slots)
    if budget is not None:
        budget.use(forecast)
    events = JobMonitor(recorder, stop, per_shard, JobProgress(shown, per_shard, done, left), left)
    recorder_of_run = RunRecorder(run)
    return drive(shards, make_task, executor, recorder_of_run, policy, events, stop, budget=budget)


def _judged(plan: JobPlan, summary: JobSummary) -> JobSummary:
    """Decide whether a finished job failed, by the quarantined share of the whole run.

    The driver knows only its own shards, which may be the last two of a thousand.
    """
    if summary.end not in ("complete", "failed") or summary.remaining:
        return summary
    quarantined = planned = 0
    for job_run in plan.runs:
        shards = job_run.run.planned()
        planned += len(shards)
        quarantined += sum(shard in shards for shard in job_run.run.quarantined())
    policy = RetryPolicy(max_quarantined_share=plan.options.max_quarantined)
    failed = too_many_quarantined(policy, quarantined, planned)
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


def _finish(plan: JobPlan, summary: JobSummary) -> JobResult:
    """Seal the run, unless the job was stopped, and return the result."""
    totals, runs = summary.totals, [job_run.run for job_run in plan.runs]
    causes = Counter(r.causes[-1] for run in runs for r in run.quarantine_records() if r.causes)
    if summary.end == "aborted":
        fix = f"Then resume: {command_line(plan.resume)}"
        raise _CannotContinue(plan.path, "", f"the job cannot continue: {summary.cause}", fix)
    does_seal = summary.end not in ("interrupted", "budget") and any(run.committed() for run in runs)
    return JobResult(
        path=plan.path,
        end=summary.end,
        n=sum(run.n for run in runs),
        made_from=made_from(run.manifest for run in runs),
        labels=totals.labels,
        positives=totals.positives,
        shards=totals.shards,
        remaining=summary.remaining,
        quarantined=tuple(shard for run in runs for shard in sorted(run.quarantined())),
        retries=totals.retries,
        start_s=summary.start_s,
        elapsed_s=summary.elapsed_s,
        store=seal(plan.storage) if does_seal else "",
        budget=plan.options.budget or "",
        cause=summary.cause or (causes.most_common(1)[0][0] if causes else ""),
        resume=tuple(plan.resume),
    )


class JobRecorder:
    """The status records of one job over one run or several. `shards` is the number that it has to make.

    A state that cannot be written, or a request that cannot be read, is ignored: an error of the store also
    fails the commits, which report it.
    """

    def __init__(self, jobs: Jobs, record: JobRecord, shards: int) -> None:
        self._jobs, self._record, self._shards = jobs, record, shards
        self._before = JobTotals(0)  # of the runs that this job has finished
        self._last = JobState(id=record.id, updated=utc_now(), phase="starting", shards=shards)

    def begin(self) -> None:
        """Publish the job. InputError where its record cannot be written: then no shard could be."""
        self._jobs.begin(self._record)
        self._put(self._last)

    def add(self, totals: JobTotals) -> None:
        """Record that a run is finished; `totals` are the job's so far."""
        self._before = totals

    def publish(self, status: JobStatus) -> None:
        totals, interval = self._before.plus(status.totals), status.left_80_s
        self._put(
            self._last.model_copy(
                update={
                    **_counts(totals),
                    "updated": utc_now(),
                    "phase": "making",
                    "labels_per_s": status.labels_per_s,
                    "left_s": status.left_s,
                    "left_80_s": interval and (interval.low, interval.high),
                    "stopping": status.stopping,
                }
            )
        )

    def stop_requested(self) -> StopMode | None:
        with suppress(InputError):
            if (order := self._jobs.stop_order(self._record.id)) is not None:
                return "force" if order.now else "drain"
        return None

    def seal(self) -> None:
        """Publish that the shards are made and the store is being sealed."""
        self._put(self._last.model_copy(update={"updated": utc_now(), "phase": "sealing", "in_flight": 0}))

    def end(self, end: JobEnd | End, code: int, cause: str, summary: JobSummary | None = None) -> None:
        """Publish how the job ended."""
        update = {
            "updated": utc_now(),
            "phase": "ended",
            "end": end,
            "exit_code": code,
            "cause": cause,
            "in_flight": 0,
            "left_s": None,
            "left_80_s": None,
        }
        if summary is not None:
            rate = summary.totals.labels / summary.elapsed_s if summary.elapsed_s > 0 else 0.0
            update |= {**_counts(summary.totals), "in_flight": 0, "labels_per_s": rate}
        self._put(self._last.model_copy(update=update))

    def _put(self, state: JobState) -> None:
        self._last = state
        with suppress(InputError):
            self._jobs.put_state(state)


def _counts(totals: JobTotals) -> dict[str, int]:
    return {
        "done": totals.finished,
        "in_flight": totals.in_flight,
        "labels": totals.labels,
        "retries": totals.retries,
        "quarantined": totals.quarantined,
    }
