"""A job: missing shards made, here or on a cluster, watched in the run, and told of at the end."""

from __future__ import annotations

import os
import platform
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Literal

from datagen.cluster.attempt import run_attempt
from datagen.cluster.books import RunBooks, close_lost_attempts
from datagen.cluster.driver import Order, drive
from datagen.cluster.executor import Executor
from datagen.cluster.fitness import refuse_unfit_machines
from datagen.cluster.guard import notes_of_a_job
from datagen.cluster.inprocess import InProcessExecutor
from datagen.cluster.policy import Policy, too_many_quarantined
from datagen.cluster.progress import JobProgress
from datagen.cluster.ray_cluster import RaySettings
from datagen.cluster.ray_executor import RayExecutor, ray_executor
from datagen.cluster.stop import StopRequest, stop_on_signals
from datagen.cluster.tally import JobSummary, Tally, no_work
from datagen.cluster.task import ShardTask
from datagen.cluster.watch import Watch
from datagen.console.command_lines import command_line
from datagen.console.printing import counted
from datagen.jobs.board import JobBoard
from datagen.jobs.options import Placing
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobEnd, JobRecord, Jobs, new_job_id
from datagen.schemas.progress import Progress
from datagen.schemas.record_files import now
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage

# Set for the driver of a detached job: its name at the Jobs API, and where that listens.
SUBMISSION, JOBS_API = "DATAGEN_SUBMISSION", "DATAGEN_JOBS_API"


@dataclass(frozen=True, eq=False)
class JobResult:
    """What a job did, and what its run holds now. Quarantined shards are those that kept failing."""

    path: str  # the run, as it was named
    # detached: Ray makes the labels. failed: more shards are quarantined than allowed.
    end: Literal["complete", "failed", "interrupted", "aborted", "detached"]
    n: int = 0  # labels wanted
    labels: int = 0  # made by this job
    positives: int = 0  # of those
    shards: int = 0  # that were missing when the job began
    remaining: int = 0  # of those, still missing
    quarantined: tuple[int, ...] = ()
    retries: int = 0
    start_s: float = 0.0  # until the first shard began
    elapsed_s: float = 0.0  # from then on
    store: str = ""  # the sealed store, which zarr and xarray open
    cause: str = ""  # of an aborted job, and the most frequent one of a failed job
    resume: tuple[str, ...] = ()  # the words of the command that continues

    @property
    def complete(self) -> bool:
        """Whether the run has all labels that were wanted, but for the allowed share in quarantine."""
        return self.end == "complete"

    @property
    def exit_code(self) -> int:
        """The command line's exit status: 0 good, 1 too many failures, 2 bad place, 130 stopped."""
        return {"complete": 0, "detached": 0, "failed": 1, "aborted": 2, "interrupted": 130}[self.end]


class JobInterrupted(KeyboardInterrupt):
    """A job ended because it was asked to; what is committed stays, and `result` says what that is."""

    def __init__(self, result: JobResult) -> None:
        self.result = result
        left = counted(result.remaining, "shard")
        super().__init__(f"{left} to go. Continue with: {command_line(result.resume)}")


@dataclass(frozen=True, eq=False)
class Work:
    """One run of a job, and where its sources lie."""

    run: Run
    houses: str  # source references, absolute
    objects: str
    scenes_from: str = ""  # the run whose scenes are labelled again; "" draws new ones


@dataclass(frozen=True, eq=False)
class JobPlan:
    """What a job does: the missing shards of one run, or of the parts of a merged place."""

    place: Storage  # where the job's records and the sealed store go
    name: str  # the place as the user wrote it
    works: Sequence[Work]
    placing: Placing
    began_s: float  # by the monotonic clock, when the command began to open them
    command: Sequence[str]  # the words of the command that it is
    resume: Sequence[str]  # the words of the command that goes on with it


def carry_out(plan: JobPlan) -> JobResult:
    """Make every missing shard, seal, and return what was done.

    While it works, the job is known in the place, and heeds requests to stop that are left there.
    InputError where it met what no retry cures.
    """
    if not _count_missing(plan):
        for work in plan.works:
            close_lost_attempts(work.run)
        return _finish(plan, _judged(plan, no_work()))
    board = open_board(plan)
    try:
        summary = _judged(plan, make_missing(plan, board))
        board.seal()
        result = _finish(plan, summary)
    except BaseException as error:
        end, code = _end_of(error)
        board.end(end, code, " ".join(str(error).split())[:1000])
        raise
    board.end(summary.end, result.exit_code, summary.cause, summary)
    return result


def _end_of(error: BaseException) -> tuple[JobEnd, int]:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", 130
    if isinstance(error, _CannotGoOn):
        return "aborted", 2
    return "broken", 2 if isinstance(error, InputError) else 1


def open_board(plan: JobPlan) -> JobBoard:
    """Make the job known in its place."""
    record = JobRecord(
        id=new_job_id(),
        command=("datagen", *plan.command),
        host=platform.node(),
        pid=os.getpid(),
        started=now(),
        address=plan.placing.address,
        submission=os.environ.get(SUBMISSION, ""),
        jobs_api=os.environ.get(JOBS_API, ""),
    )
    board = JobBoard(Jobs(plan.place), record, _count_missing(plan))
    board.begin()
    return board


def _count_missing(plan: JobPlan) -> int:
    return sum(len(work.run.missing()) for work in plan.works)


def make_missing(plan: JobPlan, board: JobBoard) -> JobSummary:
    """Drive one run after the other on one set of workers; how that ended."""
    missing = [work.run.missing() for work in plan.works]
    placing, stop = plan.placing, StopRequest()
    policy = Policy(max_quarantined_share=placing.max_quarantined)
    whole = no_work()
    with ExitStack() as stack:
        notes = stack.enter_context(notes_of_a_job())
        shown = stack.enter_context(placing.display())
        executor = _executor(placing, sum(map(len, missing)), stack, shown)
        stack.enter_context(stop_on_signals(stop, interrupt=placing.workers == 0))
        for work, shards in zip(plan.works, missing, strict=True):
            if whole.end in ("interrupted", "aborted"):
                whole = replace(whole, tally=whole.tally.plus(Tally(len(shards))))
            elif shards:
                whole = whole.plus(_drive(work, shards, executor, policy, board, stop, shown, notes))
                board.add(whole.tally)
        whole = replace(whole, start_s=time.monotonic() - plan.began_s - whole.elapsed_s)
    for work in plan.works:
        # What a killed driver left open is closed last: its workers may outlive it and still commit.
        close_lost_attempts(work.run)
    return whole


def _drive(
    work: Work,
    shards: Sequence[int],
    executor: Executor[ShardTask],
    policy: Policy,
    board: JobBoard,
    stop: StopRequest,
    shown: Progress,
    notes: str,
) -> JobSummary:
    run = work.run
    layout, spec = run.layout, run.manifest.spec

    def make_task(order: Order) -> ShardTask:
        return ShardTask(
            run=run.storage.url,
            spec=spec,
            layout=layout,
            shard=order.shard,
            attempt=order.attempt,
            houses=work.houses,
            objects=work.objects,
            deadline_s=order.deadline_s,
            notes=notes,
            scenes_from=work.scenes_from,
        )

    if isinstance(executor, RayExecutor):
        shown.phase("checking the machines")
        probe = make_task(Order(shards[0], "probe", deadline_s=0.0))
        refuse_unfit_machines(executor.others.ask, run, probe)
    done, per_shard = len(run.planned()) - len(shards), layout.samples_per_shard
    shown.phase("making labels")
    events = Watch(board, stop, per_shard, JobProgress(shown, per_shard, done))
    return drive(shards, make_task, executor, RunBooks(run), policy, events, stop)


def _judged(plan: JobPlan, summary: JobSummary) -> JobSummary:
    """Judge a job that left nothing to do by the share of the whole run that is given up.

    The driver knows its own shards alone, which may be the last two of a thousand.
    """
    if summary.end not in ("complete", "failed") or summary.remaining:
        return summary
    given_up = planned = 0
    for work in plan.works:
        shards = work.run.planned()
        planned += len(shards)
        given_up += sum(shard in shards for shard in work.run.quarantined())
    policy = Policy(max_quarantined_share=plan.placing.max_quarantined)
    failed = too_many_quarantined(policy, given_up, planned)
    return replace(summary, end="failed" if failed else "complete")


def _executor(placing: Placing, shards: int, stack: ExitStack, shown: Progress) -> Executor[ShardTask]:
    if placing.workers == 0:
        return InProcessExecutor(run_attempt)
    shown.phase("starting Ray")
    cores = len(os.sched_getaffinity(0))
    workers = min(placing.workers or cores, shards)  # Ray starts them all at once
    ray_settings = RaySettings(address=placing.address, workers=workers)
    return stack.enter_context(ray_executor(run_attempt, ray_settings))


class _CannotGoOn(InputError):
    """The job met what no retry cures."""


def _finish(plan: JobPlan, summary: JobSummary) -> JobResult:
    """Seal what there is, unless interrupted; what was done."""
    tally, runs = summary.tally, [work.run for work in plan.works]
    causes = Counter(r.causes[-1] for run in runs for r in run.quarantine_records() if r.causes)
    result = JobResult(
        path=plan.name,
        end=summary.end,
        n=sum(run.n for run in runs),
        labels=tally.labels,
        positives=tally.positives,
        shards=tally.shards,
        remaining=summary.remaining,
        quarantined=tuple(shard for run in runs for shard in sorted(run.quarantined())),
        retries=tally.retries,
        start_s=summary.start_s,
        elapsed_s=summary.elapsed_s,
        cause=summary.cause or (causes.most_common(1)[0][0] if causes else ""),
        resume=tuple(plan.resume),
    )
    if summary.end == "aborted":
        mend = f"Then resume: {command_line(plan.resume)}"
        raise _CannotGoOn(plan.name, "", f"the job cannot go on: {summary.cause}", mend)
    if summary.end != "interrupted" and any(run.committed() for run in runs):
        result = replace(result, store=seal(plan.place))
    return result
