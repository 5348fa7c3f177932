"""Records of the jobs of a run: their drivers, progress, and stop requests.

`jobs/<id>.json` identifies the driver; `jobs/<id>.state.json` is replaced while the job runs, last with its
end; `jobs/<id>.stop` asks it to stop. Data depends only on commits, not on these records.
"""

from __future__ import annotations

import platform
import re
import secrets
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Annotated, Literal

import psutil
from pydantic import Field

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, encode_record, read_record
from datagen.schemas.run_records import FORMAT_VERSION, StoredRecord
from datagen.schemas.storage import Storage

JobId = Annotated[str, Field(pattern=r"^[0-9]{8}T[0-9]{6}-[0-9a-f]{8}$")]
JobEnd = Literal["", "complete", "interrupted", "failed", "aborted", "broken"]
Stop = Literal["now", "drain"]
Health = Literal["ended", "live", "silent", "dead"]
SILENT_AFTER = timedelta(minutes=1)
_AHEAD = timedelta(minutes=5)  # clocks of machines differ by less
# A process that began after the job's record was written only reuses its number.
_PID_SLACK_S = 5.0
_JOB_FILE = re.compile(r"jobs/([0-9]{8}T[0-9]{6}-[0-9a-f]{8})\.json")


class JobRecord(StoredRecord):
    """jobs/<id>.json: a driver that began. Written once, create-only."""

    format_version: int = FORMAT_VERSION
    id: JobId
    command: tuple[str, ...]
    host: str
    pid: int = Field(ge=0)
    started: str
    address: str  # local, or the address of the Ray cluster
    submission: str = ""  # of older versions: name and address in Ray's Jobs API
    jobs_api: str = ""


class JobState(StoredRecord):
    """jobs/<id>.state.json: progress of a driver, every few seconds, and its end."""

    format_version: int = FORMAT_VERSION
    id: JobId
    updated: str
    phase: Literal["starting", "making", "sealing", "ended"]
    shards: int = Field(default=0, ge=0)  # without those of earlier jobs
    done: int = Field(default=0, ge=0)
    in_flight: int = Field(default=0, ge=0)
    labels: int = Field(default=0, ge=0)
    labels_per_s: float = Field(default=0, ge=0)  # over the last minute; after the end, over the job
    left_s: float | None = None  # None while the rate is not known
    retries: int = Field(default=0, ge=0)
    quarantined: int = Field(default=0, ge=0)
    stopping: str = ""  # why no new shard is started
    end: JobEnd = ""
    exit_code: int | None = None
    cause: str = ""


@dataclass(frozen=True)
class StoredJob:
    """All records of one job."""

    record: JobRecord
    state: JobState | None  # None between its first two writes
    stop: Stop | None = None  # whether it was asked to stop: at once, or after the running attempts

    @property
    def id(self) -> str:
        return self.record.id

    def silence(self, at: datetime | None = None) -> timedelta:
        """Time since the last sign. One that is far ahead of the clock is no sign of life, but as old."""
        last = self.state.updated if self.state else self.record.started
        silence = (at or datetime.now(UTC)) - _time_of(last)
        return max(silence, timedelta()) if silence > -_AHEAD else -silence

    def health(self, at: datetime | None = None) -> Health:
        """ended, live, dead, or silent: on another machine, without a record for a minute."""
        if self.state is not None and self.state.end:
            return "ended"
        if self.silence(at) <= SILENT_AFTER:
            return "live"
        if self.record.host != platform.node():
            return "silent"
        return "live" if _is_running(self.record) else "dead"


class Jobs:
    """The jobs of one run, or of merged runs."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage

    def begin(self, record: JobRecord) -> None:
        if not self._storage.put_new(f"jobs/{record.id}.json", encode_record(record)):
            where = f"{self._storage.url}/jobs/{record.id}.json"
            raise InputError(where, "", "exists already", "Start the job again: it gets another name")

    def put_state(self, state: JobState) -> None:
        """Publish a state, unless the job's record is gone, as with a run that another one has replaced."""
        if self._storage.exists(f"jobs/{state.id}.json"):
            self._storage.put(f"jobs/{state.id}.state.json", encode_record(state), durably=False)

    def ask_to_stop(self, job: str, at_once: bool) -> None:
        """Ask a job to stop. A request to stop at once is not replaced by a weaker one."""
        if self.stop_of(job) != "now":
            self._storage.put(f"jobs/{job}.stop", b"now" if at_once else b"drain", durably=False)

    def stop_of(self, job: str) -> Stop | None:
        data = self._storage.get(f"jobs/{job}.stop", MAX_RECORD_BYTES)
        return "now" if data == b"now" else "drain" if data == b"drain" else None

    def get(self, job: str) -> StoredJob | None:
        """Read one job; None where it does not exist. InputError where its record is damaged."""
        where = f"{self._storage.url}/jobs/{job}.json"
        try:
            record = read_record(self._storage, f"jobs/{job}.json", JobRecord)
        except InputError as error:
            fix = "Remove it: no data depends on it"
            raise InputError(where, error.field, error.problem, fix) from error
        if record is None:
            return None
        if record.id != job:
            raise InputError(where, "id", f"is {record.id}, not {job}", "Remove this foreign file")
        # Replaced too often for fsync: after a power cut a state may be torn, and then counts as absent.
        state = None
        with suppress(InputError):
            state = read_record(self._storage, f"jobs/{job}.state.json", JobState)
        return StoredJob(record, state, self.stop_of(job))

    def all(self) -> list[StoredJob]:
        names = (_JOB_FILE.fullmatch(file.key) for file in self._storage.list("jobs"))
        found = [job for name in names if name and (job := self.get(name[1])) is not None]
        # Names have seconds only, and two jobs may begin within one.
        return sorted(found, key=lambda job: (job.record.started, job.record.id))


def new_job_id() -> str:
    """A unique name that sorts by time."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{secrets.token_hex(4)}"


def _time_of(text: str) -> datetime:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return datetime.fromtimestamp(0, UTC)  # an invalid time
    return time if time.tzinfo else time.replace(tzinfo=UTC)


def _is_running(record: JobRecord) -> bool:
    try:
        began = psutil.Process(record.pid).create_time()
    except (psutil.NoSuchProcess, ValueError, OverflowError):
        return False
    except psutil.AccessDenied:
        return True
    return began <= _time_of(record.started).timestamp() + _PID_SLACK_S
