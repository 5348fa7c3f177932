"""Progress of a job: its driver's events, shown on standard error and published in the run.

A job's records (`schemas/jobs.py`) tell other processes how far it is, and hold their requests to stop it.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from contextlib import suppress

from datagen.cluster.attempt_guard import Running, running_attempts
from datagen.cluster.protocol import AttemptReport, JobSummary, JobTotals, StopRequest
from datagen.display.progress import Pace, Progress, clock_text, whole
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobEnd, JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.record_files import utc_now
from datagen.schemas.storage.errors import StoreUnavailable

BEAT_S, LOOK_S = 10.0, 3.0  # between two states, and between two looks for a request to stop
NOTES_S = 1.0  # between two looks at the progress of running attempts


class JobProgress:
    """A driver's events, shown: shards done, rate, time left, retries, quarantined shards, cost so far.

    `done_before` counts the shards of earlier jobs, `labels_after` the labels of runs that the job makes
    later. Rate and time left include the labels of unfinished shards on this machine, from the job's notes.
    """

    def __init__(
        self,
        shown: Progress,
        labels_per_shard: int,
        done_before: int = 0,
        notes: str = "",
        labels_after: int = 0,
    ) -> None:
        self._shown, self._pace, self._labels_per_shard = shown, Pace(shown.clock), labels_per_shard
        self._done_before, self._labels_after, self._reason = done_before, labels_after, ""
        self._notes, self._running, self._next_note_s = notes, Running(), float("-inf")

    def ended(self, report: AttemptReport, action: str) -> None:
        if action in ("retry", "quarantine", "abort"):
            values = {name: getattr(report, name) for name in ("shard", "attempt", "cause")}
            text = f"shard {report.shard} {report.outcome}: {report.cause} ({action})"
            style = "yellow" if action == "retry" else "red"
            self._shown.say("attempt_" + report.outcome, {**values, "action": action}, text, style)

    def tick(self, totals: JobTotals) -> None:
        if (now_s := self._shown.clock()) >= self._next_note_s:
            self._running, self._next_note_s = running_attempts(self._notes), now_s + NOTES_S
        self._pace.see(totals.labels + self._in_flight(totals))
        done, of = self._done_before + totals.finished, self._done_before + totals.shards
        self._shown.update("shards", done, of, lambda: self._figures(totals))

    def stopping(self, reason: str) -> None:
        self._reason = reason
        text = f"{reason}: waiting for running attempts; Ctrl-C again stops at once"
        self._shown.say("stopping", {"reason": reason}, text, "yellow")

    def left_s(self, totals: JobTotals) -> float | None:
        """Seconds until the job's last shard at the rate of the last minute; None while it is unknown."""
        more = (totals.shards - totals.finished) * self._labels_per_shard + self._labels_after
        return self._pace.left_s(more - self._in_flight(totals))

    def _in_flight(self, totals: JobTotals) -> int:
        """Labels of running attempts, but no more than they will commit: drawn scenes may be rejected."""
        return min(self._running.labels, totals.in_flight * self._labels_per_shard)

    def _figures(self, totals: JobTotals) -> tuple[str, dict[str, object]]:
        rate, left_s = self._pace.per_s(), self.left_s(totals)
        cpu_s = totals.useful_cpu_s + totals.wasted_cpu_s
        grasps = self._running.in_grasps
        text = "  ".join(
            part
            for part, is_shown in (
                (f"{rate:,.0f} labels/s", True),
                (f"{clock_text(left_s)} left", True),
                # Rare figures are omitted when 0, and the cost while others need its room, to fit 80 columns.
                (f"computing grasps of {grasps} object{'s' if grasps > 1 else ''}", grasps),
                (f"{totals.retries} retries", totals.retries),
                (f"{totals.quarantined} quarantined", totals.quarantined),
                (f"{cpu_s / 3600:.2f} core-h", not grasps),
                ("stopping", self._reason),
            )
            if is_shown
        )
        return text, {
            "shards_done": self._done_before + totals.finished,
            "shards": self._done_before + totals.shards,
            "labels": totals.labels,
            "labels_in_flight": self._running.labels,
            "objects_in_grasps": self._running.in_grasps,
            "labels_per_s": round(rate, 1),
            "left_s": whole(left_s),
            "in_flight": totals.in_flight,
            "retries": totals.retries,
            "quarantined": totals.quarantined,
            "cpu_s": round(cpu_s, 1),
            "wasted_wall_s": round(totals.wasted_wall_s, 1),
        }


class JobMonitor(JobProgress):
    """A driver's events, shown and published every `BEAT_S`; looks for requests to stop every `LOOK_S`.

    `check` raises InputError where the job must end; it is called before each state.
    """

    def __init__(
        self,
        recorder: JobRecorder,
        stop: StopRequest,
        shown: Progress,
        labels_per_shard: int,
        done_before: int = 0,
        notes: str = "",
        check: Callable[[], None] = lambda: None,
        labels_after: int = 0,
    ) -> None:
        super().__init__(shown, labels_per_shard, done_before, notes, labels_after)
        self._check = check
        self._recorder, self._stop, self._clock = recorder, stop, shown.clock
        self._next_beat_s = self._next_look_s = self._clock()

    def stopping(self, reason: str) -> None:
        super().stopping(reason)
        self._next_beat_s = self._clock()  # published at the next tick

    def tick(self, totals: JobTotals) -> None:
        super().tick(totals)
        now_s = self._clock()
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + LOOK_S
            self._recorder.pass_on_request(self._stop)
        if now_s >= self._next_beat_s:
            self._next_beat_s = now_s + BEAT_S
            with suppress(StoreUnavailable):
                self._check()
            self._recorder.publish(totals, self._pace.per_s(), self.left_s(totals), self._reason)


class JobRecorder:
    """Writes the records of one job over one run or several. `shards` is the number that it has to make.

    A state that cannot be written, or a request that cannot be read, is ignored: an error of the store also
    fails the commits, which report it.
    """

    def __init__(self, jobs: Jobs, command: tuple[str, ...], address: str, shards: int) -> None:
        """Publish the job. InputError where its record cannot be written: then no shard could be."""
        self._jobs = jobs
        record = JobRecord(
            id=new_job_id(),
            command=command,
            host=platform.node(),
            pid=os.getpid(),
            started=utc_now(),
            address=address,
        )
        self._before = JobTotals(0)  # sums over the finished runs
        self._state = JobState(id=record.id, updated=record.started, phase="starting", shards=shards)
        jobs.begin(record)
        self._put()

    def add(self, totals: JobTotals) -> None:
        """Record that a run is finished; `totals` are the job's so far."""
        self._before = totals

    def publish(self, totals: JobTotals, labels_per_s: float, left_s: float | None, stopping: str) -> None:
        """Publish the progress of the current run; `stopping` is why no new shard is started."""
        counts = _counts(self._before.plus(totals))
        self._put(phase="making", labels_per_s=labels_per_s, left_s=left_s, stopping=stopping, **counts)

    def pass_on_request(self, stop: StopRequest) -> None:
        """Make the request of another process, if any; one that a signal has made before counts once.

        Where the store fails, no attempt of a stopped job can commit: it stops at once.
        """
        try:
            asked = self._jobs.stop_of(self._state.id)
        except InputError as error:
            asked = "now" if stop.drain and isinstance(error, StoreUnavailable) else None
        while asked is not None and not (stop.force if asked == "now" else stop.drain):
            stop.ask()

    def seal(self, totals: JobTotals) -> None:
        """Publish that the shards are made, with the totals of the job, and the store is being sealed."""
        self._put(phase="sealing", **_counts(totals) | {"in_flight": 0})

    def end(self, end: JobEnd, code: int, cause: str, summary: JobSummary | None = None) -> None:
        counts: dict[str, float] = {}
        if summary is not None:
            counts |= _counts(summary.totals)
            counts["labels_per_s"] = summary.totals.labels / max(summary.elapsed_s, 1e-6)
        self._put(
            phase="ended", end=end, exit_code=code, cause=cause, left_s=None, **counts | {"in_flight": 0}
        )

    def _put(self, **changes: object) -> None:
        self._state = self._state.model_copy(update={"updated": utc_now(), **changes})
        with suppress(InputError):
            self._jobs.put_state(self._state)


def _counts(totals: JobTotals) -> dict[str, float]:
    return {
        "done": totals.finished,
        "in_flight": totals.in_flight,
        "labels": totals.labels,
        "retries": totals.retries,
        "quarantined": totals.quarantined,
    }
