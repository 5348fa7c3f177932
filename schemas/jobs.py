"""Jobs at a place: who works on it, how far they are, and requests that they stop.

`jobs/<id>.json` says who began; `jobs/<id>.state.json` is replaced while the job lives and says at the end
how it ended; `jobs/<id>.stop.json` asks it to stop. They decide nothing about data: commits alone do.
"""

from __future__ import annotations

import platform
import re
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Annotated, Literal, TypeVar

import psutil
from pydantic import BaseModel, Field

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, decode_record, encode_record, read_record, utc_now
from datagen.schemas.run_records import FORMAT_VERSION, StoredRecord
from datagen.schemas.storage import Storage

JobId = Annotated[str, Field(pattern=r"^[0-9]{8}T[0-9]{6}-[0-9a-f]{8}$")]
JobEnd = Literal["", "complete", "interrupted", "failed", "aborted", "broken"]
Health = Literal["ended", "live", "silent", "dead"]
SILENT_AFTER = timedelta(minutes=1)
# A process that began later than the job's record was written has only taken over its number.
_PID_SLACK_S = 5.0
_JOB_FILE = re.compile(r"jobs/([0-9]{8}T[0-9]{6}-[0-9a-f]{8})\.json")


Replaced = TypeVar("Replaced", bound=BaseModel)


class JobRecord(StoredRecord):
    """jobs/<id>.json: a driver that began. Written once, create-only."""

    format_version: int = FORMAT_VERSION
    id: JobId
    command: tuple[str, ...]
    host: str
    pid: int = Field(ge=0)
    started: str
    address: str  # local, or that of the Ray cluster it works on
    submission: str = ""  # of a detached job: its name at the Jobs API, and where that listens
    jobs_api: str = ""


class JobState(StoredRecord):
    """jobs/<id>.state.json: how a driver is, every few seconds, and how it ended."""

    format_version: int = FORMAT_VERSION
    id: JobId
    updated: str
    phase: Literal["starting", "making", "sealing", "ended"]
    shards: int = Field(default=0, ge=0)  # of this job, without those done before it
    done: int = Field(default=0, ge=0)
    in_flight: int = Field(default=0, ge=0)
    labels: int = Field(default=0, ge=0)
    labels_per_s: float = Field(default=0, ge=0)  # over the last minute; over the job once it ended
    left_s: float | None = None  # None while the rate is not known
    retries: int = Field(default=0, ge=0)
    quarantined: int = Field(default=0, ge=0)
    stopping: str = ""  # why nothing new is begun
    end: JobEnd = ""
    exit_code: int | None = None
    cause: str = ""


class StopRecord(StoredRecord):
    """jobs/<id>.stop.json: somebody wants the job to stop."""

    format_version: int = FORMAT_VERSION
    id: JobId
    now: bool  # end what is in flight by force
    asked: str
    host: str


@dataclass(frozen=True)
class StoredJob:
    """All that the place knows of one job."""

    record: JobRecord
    state: JobState | None  # None in the moment between its two first writes
    order: StopRecord | None

    @property
    def id(self) -> str:
        return self.record.id

    def silence(self, at: datetime | None = None) -> timedelta:
        """Time since it was last heard of."""
        heard = self.state.updated if self.state else self.record.started
        return max((at or datetime.now(UTC)) - _time_of(heard), timedelta())

    def health(self, at: datetime | None = None) -> Health:
        """Whether it has ended, lives, is dead, or is somewhere else and has not been heard for a minute."""
        if self.state is not None and self.state.end:
            return "ended"
        if self.silence(at) <= SILENT_AFTER:
            return "live"
        if self.record.host != platform.node():
            return "silent"
        return "live" if _is_running(self.record) else "dead"


class Jobs:
    """The jobs of one place: a run, or several that were merged."""

    def __init__(self, place: Storage) -> None:
        self._place = place

    def begin(self, record: JobRecord) -> None:
        """Note that a job begins."""
        if not self._place.put_new(f"jobs/{record.id}.json", encode_record(record)):
            where = f"{self._place.url}/jobs/{record.id}.json"
            raise InputError(where, "", "this job has already begun", "Start it again: it gets another name")

    def put_state(self, state: JobState) -> None:
        """Replace what is known of a job."""
        self._place.put(f"jobs/{state.id}.state.json", encode_record(state))

    def ask_to_stop(self, job: str, at_once: bool) -> None:
        """Ask a job to stop. A request to end at once is not taken back by a gentler one."""
        standing = self.stop_order(job)
        if standing is None or (at_once and not standing.now):
            order = StopRecord(id=job, now=at_once, asked=utc_now(), host=platform.node())
            self._place.put(f"jobs/{job}.stop.json", encode_record(order))

    def stop_order(self, job: str) -> StopRecord | None:
        """The request to stop that stands for a job."""
        return self._passing(f"jobs/{job}.stop.json", StopRecord)

    def get(self, job: str) -> StoredJob | None:
        """One job; None where there is none of this name. InputError where its record is damaged."""
        where = f"{self._place.url}/jobs/{job}.json"
        try:
            record = read_record(self._place, f"jobs/{job}.json", JobRecord)
        except InputError as error:
            mend = "Remove it: it says who worked here, and nothing about data"
            raise InputError(where, error.field, error.problem, mend) from error
        if record is None:
            return None
        if record.id != job:
            raise InputError(where, "id", f"{record.id}, not {job}", "Remove this foreign file")
        return StoredJob(record, self._passing(f"jobs/{job}.state.json", JobState), self.stop_order(job))

    def all(self) -> list[StoredJob]:
        """Every job that began here, in order of time."""
        names = (_JOB_FILE.fullmatch(file.key) for file in self._place.list("jobs"))
        found = [job for name in names if name and (job := self.get(name[1])) is not None]
        # Names tell seconds only, and two jobs may begin within one.
        return sorted(found, key=lambda job: (job.record.started, job.record.id))

    def _passing(self, key: str, model: type[Replaced]) -> Replaced | None:
        # Replaced too often to be made durable: a power cut may tear it, which is as if it were absent.
        data = self._place.get(key, MAX_RECORD_BYTES)
        if data is None:
            return None
        try:
            return decode_record(key, data, model)
        except InputError:
            return None


def new_job_id() -> str:
    """A name that sorts by time and is nobody else's."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{secrets.token_hex(4)}"


def _time_of(text: str) -> datetime:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return datetime.fromtimestamp(0, UTC)  # a record that was made up says nothing
    return time if time.tzinfo else time.replace(tzinfo=UTC)


def _is_running(record: JobRecord) -> bool:
    try:
        began = psutil.Process(record.pid).create_time()
    except (psutil.NoSuchProcess, ValueError, OverflowError):
        return False
    except psutil.AccessDenied:
        return True
    return began <= _time_of(record.started).timestamp() + _PID_SLACK_S
