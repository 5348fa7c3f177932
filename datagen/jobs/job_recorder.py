"""Writes the status records of a job, and reads requests to stop it. Errors here never stop the work."""

from __future__ import annotations

from contextlib import suppress

from datagen.cluster.job_progress import JobStatus, StopMode
from datagen.cluster.job_totals import End, JobSummary, JobTotals
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobEnd, JobRecord, Jobs, JobState
from datagen.schemas.record_files import utc_now


class JobRecorder:
    """The status records of one job over one run or several. `shards` are all that it has to make.

    A state that cannot be written, or a request that cannot be read, is passed over: what is wrong with
    the store is said by the commits.
    """

    def __init__(self, jobs: Jobs, record: JobRecord, shards: int) -> None:
        self._jobs, self._record, self._shards = jobs, record, shards
        self._before = JobTotals(0)  # of the runs that this job is through with
        self._last = JobState(id=record.id, updated=utc_now(), phase="starting", shards=shards)

    def begin(self) -> None:
        """Make the job known. InputError where that cannot be written: then nothing could."""
        self._jobs.begin(self._record)
        self._put(self._last)

    def add(self, totals: JobTotals) -> None:
        """One run is done; `totals` is the job's up to here."""
        self._before = totals

    def publish(self, status: JobStatus) -> None:
        totals = self._before.plus(status.totals)
        self._put(
            self._last.model_copy(
                update={
                    **_counts(totals),
                    "updated": utc_now(),
                    "phase": "making",
                    "labels_per_s": status.labels_per_s,
                    "left_s": status.left_s,
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
        """Say that the shards are made and the store is laid."""
        self._put(self._last.model_copy(update={"updated": utc_now(), "phase": "sealing", "in_flight": 0}))

    def end(self, end: JobEnd | End, code: int, cause: str, summary: JobSummary | None = None) -> None:
        """Say how the job ended."""
        update = {
            "updated": utc_now(),
            "phase": "ended",
            "end": end,
            "exit_code": code,
            "cause": cause,
            "in_flight": 0,
            "left_s": None,
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
