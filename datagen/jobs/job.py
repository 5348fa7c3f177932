"""A job: missing shards made, here or on a cluster, watched in the run, and told of at the end."""

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
from datagen.console.command_lines import command_line, say_interrupted
from datagen.console.printing import counted, listed, print_rows, seconds
from datagen.jobs.board import JobBoard
from datagen.jobs.options import JOBS_API, SUBMISSION, Placing
from datagen.schemas.errors import InputError, one_line
from datagen.schemas.jobs import JobEnd, JobRecord, Jobs, new_job_id
from datagen.schemas.progress import Progress
from datagen.schemas.record_files import now
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage

# Set for the driver of a detached job: its name at the Jobs API, and where that listens.


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
    resume: Sequence[str]  # the words of the command that goes on with it


def carry_out(plan: JobPlan) -> int:
    """Make every missing shard, seal, and say how it went; the exit code.

    While it works, the job is known in the place, and heeds requests to stop that are left there.
    """
    if not _count_missing(plan):
        for work in plan.works:
            close_lost_attempts(work.run)
        return _finish(plan, _judged(plan, no_work()))
    board = open_board(plan)
    try:
        summary = _judged(plan, make_missing(plan, board))
        board.seal()
        code = _finish(plan, summary)
    except BaseException as error:
        end, code = _end_of(error)
        board.end(end, code, " ".join(str(error).split())[:1000])
        raise
    board.end(summary.end, code, summary.cause, summary)
    return code


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
        command=("datagen", *sys.argv[1:]),
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
        shown = stack.enter_context(Progress(placing.json))
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


def _finish(plan: JobPlan, summary: JobSummary) -> int:
    """Seal what there is, say how it went and how to go on; return the exit code."""
    tally, runs, name = summary.tally, [work.run for work in plan.works], plan.name
    n, resume = sum(run.n for run in runs), command_line(plan.resume)
    given_up = [(run, shard) for run in runs for shard in sorted(run.quarantined())]
    if tally.shards:
        labels = f"{tally.labels:,} new, {n:,} wanted"
    elif given_up:
        labels = f"nothing to do: the shards of {n:,} labels are made or given up"
    else:
        labels = f"nothing to do: all {n:,} labels are there"
    rows = [
        ("labels", labels),
        ("positive", f"{100 * tally.positives / tally.labels:.1f}%" if tally.labels else "-"),
        ("time", _time(summary)),
        ("retries", str(tally.retries)),
    ]
    if given_up:
        again = command_line(["resume", name, "--quarantined"])
        those = f"{counted(len(given_up), 'shard')} ({listed([shard for _, shard in given_up])})"
        shown = f"{those}: {again} tries again"
        rows.append(("quarantined", shown))
    if summary.end in ("complete", "failed") and any(run.committed() for run in runs):
        sealed = seal(plan.place)
        rows.append(("store", f"{sealed}: zarr.open or xarray.open_zarr reads it"))
    print_rows(f"{summary.end}: {name}", rows)
    if summary.end == "aborted":
        raise _CannotGoOn(name, "", f"the job cannot go on: {summary.cause}", f"Then resume: {resume}")
    if summary.end == "failed":
        causes = Counter(r.causes[-1] for run in runs for r in run.quarantine_records() if r.causes)
        most = f", most often by: {causes.most_common(1)[0][0]}" if causes else ""
        see = command_line(["status", name])
        sys.stderr.write(one_line(f"error: {name}: too many shards failed{most}. See: {see}") + "\n")
    if summary.end == "interrupted":
        say_interrupted(f" with {counted(summary.remaining, 'shard')} to go", plan.resume)
    return summary.exit_code


def _time(summary: JobSummary) -> str:
    if not summary.tally.labels:
        return seconds(summary.start_s + summary.elapsed_s)
    rate = summary.tally.labels / max(summary.elapsed_s, 1e-6)
    parts = f"start {seconds(summary.start_s)}, labels {seconds(summary.elapsed_s)}"
    return f"{seconds(summary.start_s + summary.elapsed_s)}: {parts} at {rate:,.0f}/s"
