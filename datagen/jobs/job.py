"""A job: make the missing shards on this machine or a cluster, publish its status, seal."""

from __future__ import annotations

import io
import os
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from datagen.cluster.attempt import probe_in, run_attempt
from datagen.cluster.attempt_guard import notes_of_a_job
from datagen.cluster.driver import drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.job_monitor import JobMonitor, JobRecorder
from datagen.cluster.protocol import (
    AttemptOrder,
    Executor,
    JobSummary,
    JobTotals,
    ShardTask,
    StopRequest,
    interrupted_by_sigterm,
    stop_on_signals,
)
from datagen.cluster.ray_cluster import RaySettings, refuse_unusable
from datagen.cluster.ray_executor import ray_executor
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy, too_many_quarantined
from datagen.console.command_lines import Interrupted, command_line, resumable
from datagen.console.options import JSON_HELP, RUNNING, Whole, option
from datagen.console.printing import counted
from datagen.display.progress import Progress
from datagen.jobs.job_report import JobResult
from datagen.reports.agreement import doubt, read_labels
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobEnd, Jobs
from datagen.schemas.run import Run, RunReplaced
from datagen.schemas.sealing import seal
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage
from datagen.schemas.storage.errors import JOBS_WAIT_S, repeated_for_minutes, repeated_until
from datagen.workers.extras import refuse_missing

_TASK_MEMORY_BYTES = 2**30  # that an attempt requests of a running cluster, twice with an arm
_RECORDED_WITHIN_S = 5.0  # the end of a job that an error has ended, perhaps of the store
_DETACH = "Check everything, then make the labels in a process that continues after this shell ends."


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class JobOptions:
    """Where and how a job runs; no option changes a sample."""

    workers: Annotated[
        Whole | None,
        option("Most worker processes; 0: this process, for debuggers. [default: one per core]", RUNNING),
    ] = None
    address: Annotated[str, option("local, or the address of a Ray cluster.", RUNNING)] = "local"
    detach: Annotated[bool, option(_DETACH, RUNNING)] = False
    no_seal: Annotated[bool, option("Leave out the joint store data.zarr; readers open runs.", RUNNING)] = (
        False
    )
    json: Annotated[bool, option(JSON_HELP, RUNNING)] = False
    quiet: Annotated[bool, Parameter(parse=False)] = False  # the command line always reports progress

    def refuse_bad(self) -> None:
        """Raise InputError for values out of range and for an unreachable cluster."""
        if self.workers is not None and not 0 <= self.workers <= 4096:
            fix = "Omit it for one per core"
            raise InputError("--workers", str(self.workers), "is not between 0 and 4096", fix)
        if self.workers == 0 and self.address != "local":
            fix = "Omit one of them: 0 workers is this process"
            raise InputError("--workers", "0", f"is given with --address {self.address}", fix)
        if self.workers != 0:
            refuse_missing("cluster", "or work in this process: --workers 0")
            refuse_unusable(self.address)

    def display(self) -> Progress:
        return Progress(self.json, console=Console(file=io.StringIO()) if self.quiet else None)


@dataclass(frozen=True, eq=False)
class JobRun:
    """One run of a job, and its sources."""

    run: Run
    houses: str  # source references, absolute
    objects: str
    scenes_from: str = ""  # the run whose scenes are labelled again; "" for new scenes
    robot: str = ""  # place of the robot's file; "" for one of the registry


@dataclass(frozen=True, eq=False)
class Job:
    """Makes the missing shards of one run, or of the parts of merged runs."""

    storage: Storage  # where the job's records and the sealed store go
    path: str  # as the user wrote it
    runs: Sequence[JobRun]
    options: JobOptions
    began_s: float  # by the monotonic clock, when the command began to open them
    command: Sequence[str] = ()  # the words of the command that started it
    resume: Sequence[str] = ()  # the words of the command that resumes it
    policy: RetryPolicy = field(default_factory=RetryPolicy)

    def run(self) -> JobResult:
        """Make every missing shard, seal, and return the result.

        Meanwhile the job publishes its state in the run, and polls it for stop requests. Raises InputError
        for an error that no retry can fix, and Interrupted where it was asked to stop.
        """
        with resumable(self.resume), interrupted_by_sigterm():
            result = self._run()
        if result.end == "interrupted":
            left = counted(result.remaining, "shard")
            raise Interrupted(f"{left} left. Resume with: {command_line(self.resume)}", result)
        return result

    def _run(self) -> JobResult:
        missing = self.missing()
        if not any(missing):
            for job_run in self.runs:
                job_run.run.close_lost_attempts()
            return self._finish(self._judged(JobSummary()))
        recorder = self.record(missing)
        try:
            summary = self._judged(self.make_missing(recorder, missing))
            recorder.seal(summary.totals)
            result = self._finish(summary)
        except BaseException as error:
            end, code = _end_of(error)
            until_s = time.monotonic() + (0.0 if end == "interrupted" else _RECORDED_WITHIN_S)
            with repeated_until(lambda: until_s):
                recorder.end(end, code, " ".join(str(error).split())[:1000])
            if isinstance(error, InputError) and not isinstance(error, _CannotContinue | RunReplaced):
                fix = f"{error.fix}. Then resume: {command_line(self.resume)}"
                raise InputError(error.place, error.field, error.problem, fix) from error
            raise
        recorder.end(summary.end, result.exit_code, summary.cause, summary)
        return result

    def missing(self) -> list[ShardRanges]:
        return [job_run.run.missing() for job_run in self.runs]

    def record(self, missing: Sequence[ShardRanges]) -> JobRecorder:
        command, shards = ("datagen", *self.command), sum(map(len, missing))
        return JobRecorder(Jobs(self.storage), command, self.options.address, shards)

    def make_missing(self, recorder: JobRecorder, missing: Sequence[ShardRanges]) -> JobSummary:
        """Drive one run after the other on one set of workers; return the summary."""
        stop, whole = StopRequest(), JobSummary()
        with ExitStack() as stack:
            notes = stack.enter_context(notes_of_a_job())
            shown = stack.enter_context(self.options.display())
            executor = self._executor(sum(map(len, missing)), stack, shown)
            stack.enter_context(stop_on_signals(stop, interrupt=self.options.workers == 0))
            sizes = [job_run.run.layout.samples_per_shard for job_run in self.runs]
            labels = [len(shards) * size for shards, size in zip(missing, sizes, strict=True)]
            for number, (job_run, shards) in enumerate(zip(self.runs, missing, strict=True), 1):
                if whole.end in ("interrupted", "aborted"):
                    whole = replace(whole, totals=whole.totals.plus(JobTotals(len(shards))))
                elif shards:
                    after = sum(labels[number:])
                    done = self._drive(job_run, shards, executor, recorder, stop, shown, notes, after)
                    whole = whole.plus(done)
                    recorder.add(whole.totals)
            whole = replace(whole, start_s=time.monotonic() - self.began_s - whole.elapsed_s)
        for job_run in self.runs:
            # Attempts of killed drivers are closed last: their workers may still commit.
            job_run.run.close_lost_attempts()
        return whole

    def _drive(
        self,
        job_run: JobRun,
        shards: Sequence[int],
        executor: Executor[ShardTask],
        recorder: JobRecorder,
        stop: StopRequest,
        shown: Progress,
        notes: str,
        labels_after: int,
    ) -> JobSummary:
        run = job_run.run
        layout, spec = run.layout, run.manifest.spec

        def make_task(order: AttemptOrder) -> ShardTask:
            return ShardTask(
                **vars(replace(order, notes=notes)),
                run=run.storage.url,
                spec=spec,
                layout=layout,
                houses=job_run.houses,
                objects=job_run.objects,
                robot=job_run.robot,
                scenes_from=job_run.scenes_from,
                probe=probe,
            )

        if spec.arm is not None and self.options.address == "local":
            _tell_compiling(shown)
        shown.phase("making labels")
        done = len(run.planned()) - len(shards)
        per_shard, check = layout.samples_per_shard, run.refuse_replaced
        events = JobMonitor(recorder, stop, shown, per_shard, done, notes, check, labels_after)
        policy = self.policy
        if run.storage.folder is None:  # attempts that wait for the store are not hung
            policy = replace(policy, min_deadline_s=policy.min_deadline_s + JOBS_WAIT_S)
        waiting = "waiting for the object store: "
        tell_trouble = repeated_for_minutes(lambda error: _tell(shown, "store", waiting + error.problem))
        with tell_trouble, probe_in(run) as probe:
            return drive(shards, make_task, executor, RunRecorder(run), policy, events, stop)

    def _executor(self, shards: int, stack: ExitStack, shown: Progress) -> Executor[ShardTask]:
        if self.options.workers == 0:
            return InProcessExecutor(run_attempt)
        shown.phase("starting Ray")
        cores = len(os.sched_getaffinity(0))
        workers = self.options.workers
        if self.options.address == "local":
            workers = min(workers or cores, shards)  # Ray starts them all at once
        has_arm = any(each.run.manifest.spec.arm for each in self.runs)
        settings = RaySettings(
            address=self.options.address,
            workers=workers,
            task_memory_bytes=_TASK_MEMORY_BYTES << has_arm,
            tell=lambda line: _tell(shown, "machines", line),
        )
        return stack.enter_context(ray_executor(run_attempt, settings))

    def _judged(self, summary: JobSummary) -> JobSummary:
        """Decide whether a finished job failed, by the quarantined share of the whole run.

        The driver knows only its own shards, which may be the last two of a thousand.
        """
        for job_run in self.runs:
            job_run.run.refuse_replaced()
        if summary.end not in ("complete", "failed") or summary.remaining:
            return summary
        quarantined = [job_run.run.quarantined() for job_run in self.runs]
        failed = False
        if any(quarantined):
            planned = [job_run.run.planned() for job_run in self.runs]
            ours = sum(shard in of for of, found in zip(planned, quarantined, strict=True) for shard in found)
            failed = too_many_quarantined(self.policy, ours, sum(map(len, planned)))
        return replace(summary, end="failed" if failed else "complete")

    def _finish(self, summary: JobSummary) -> JobResult:
        """Seal the run, unless the job was stopped, and return the result."""
        totals, runs = summary.totals, [job_run.run for job_run in self.runs]
        quarantined = [record for run in runs for record in run.quarantine_records()]
        causes = Counter(record.causes[-1] for record in quarantined if record.causes)
        if summary.end == "aborted":
            fix = f"Then resume: {command_line(self.resume)}"
            raise _CannotContinue(self.path, "", f"the job cannot continue: {summary.cause}", fix)
        return JobResult(
            path=self.path,
            end=summary.end,
            n=sum(run.samples_wanted(run.n) for run in runs),
            made_from="; ".join(dict.fromkeys(run.manifest.made_from for run in runs)),
            labels=totals.labels,
            positives=totals.positives,
            shards=totals.shards,
            remaining=summary.remaining,
            quarantined=tuple(record.shard for record in quarantined),
            retries=totals.retries,
            start_s=summary.start_s,
            elapsed_s=summary.elapsed_s,
            doubt="" if summary.end == "interrupted" or totals.positives else _doubt(runs),
            store="" if summary.end == "interrupted" or self.options.no_seal else self._seal(runs),
            cause=summary.cause or (causes.most_common(1)[0][0] if causes else ""),
            resume=tuple(self.resume),
        )

    def _seal(self, runs: Sequence[Run]) -> str:
        shards = sum(len(run.committed()) for run in runs)
        with self.options.display() as shown:
            return seal(self.storage, shown.counter("shards sealed"), runs) if shards else ""


def _doubt(runs: Sequence[Run]) -> str:
    """That of the first run that has one; a damaged shard is reported by readers, not here."""
    for run in runs:
        if run.manifest.spec.arm is not None and not any(commit.positives for commit in run.commits()):
            with suppress(InputError):
                if line := doubt(read_labels(run)):
                    return line
    return ""


def _tell_compiling(shown: Progress) -> None:
    # Imported here: labels without an arm need no compiler.
    from datagen.workers.kinematics.compiler import is_kept
    from datagen.workers.motion.search import try_pose

    # Not the folder: opening the robot has compiled a part.
    if not is_kept(try_pose):
        _tell(shown, "compiling", "compiling the planner for this machine, once: about 20 s")


def _tell(shown: Progress, event: str, line: str) -> None:
    shown.say(event, {"text": line}, line, "yellow")


class _CannotContinue(InputError):
    """The job met an error that no retry can fix."""


def _end_of(error: BaseException) -> tuple[JobEnd, int]:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", 130
    if isinstance(error, _CannotContinue):
        return "aborted", 2
    return "broken", 2 if isinstance(error, InputError) else 1
