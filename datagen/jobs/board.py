"""The status records of a job: they inform readers and never stop the work."""

from __future__ import annotations

from contextlib import suppress

from datagen.cluster.tally import End, JobSummary, Tally
from datagen.cluster.watch import Standing, Wish
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobEnd, JobRecord, Jobs, JobState
from datagen.schemas.record_files import now


class JobBoard:
    """The status of one job over one run or several. `shards` is the number of shards to make.

    A state that cannot be written and a request that cannot be read are ignored: commits report errors of
    the store.
    """

    def __init__(self, jobs: Jobs, record: JobRecord, shards: int) -> None:
        self._jobs, self._record, self._shards = jobs, record, shards
        self._before = Tally(0)  # of the runs that this job has finished
        self._last = JobState(id=record.id, updated=now(), phase="starting", shards=shards)

    def begin(self) -> None:
        """Publish the job's record. InputError where it cannot be written."""
        self._jobs.begin(self._record)
        self._put(self._last)

    def add(self, tally: Tally) -> None:
        """Note that one run is done; `tally` is the job's so far."""
        self._before = tally

    def tell(self, standing: Standing) -> None:
        tally = self._before.plus(standing.tally)
        self._put(
            self._last.model_copy(
                update={
                    **_counts(tally),
                    "updated": now(),
                    "phase": "making",
                    "labels_per_s": standing.labels_per_s,
                    "left_s": standing.left_s,
                    "stopping": standing.stopping,
                }
            )
        )

    def wish(self) -> Wish | None:
        with suppress(InputError):
            if (order := self._jobs.stop_order(self._record.id)) is not None:
                return "force" if order.now else "drain"
        return None

    def seal(self) -> None:
        """Publish that the shards are made and the store is being sealed."""
        self._put(self._last.model_copy(update={"updated": now(), "phase": "sealing", "in_flight": 0}))

    def end(self, end: JobEnd | End, code: int, cause: str, summary: JobSummary | None = None) -> None:
        """Publish how the job ended."""
        update = {
            "updated": now(),
            "phase": "ended",
            "end": end,
            "exit_code": code,
            "cause": cause,
            "in_flight": 0,
            "left_s": None,
        }
        if summary is not None:
            rate = summary.tally.labels / summary.elapsed_s if summary.elapsed_s > 0 else 0.0
            update |= {**_counts(summary.tally), "in_flight": 0, "labels_per_s": rate}
        self._put(self._last.model_copy(update=update))

    def _put(self, state: JobState) -> None:
        self._last = state
        with suppress(InputError):
            self._jobs.tell(state)


def _counts(tally: Tally) -> dict[str, int]:
    return {
        "done": tally.finished,
        "in_flight": tally.in_flight,
        "labels": tally.labels,
        "retries": tally.retries,
        "quarantined": tally.quarantined,
    }
