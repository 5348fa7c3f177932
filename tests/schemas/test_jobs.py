"""Records of jobs: who lives, who is dead, and requests that stand."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.quarantine import lift_quarantine, lifted_records
from datagen.schemas.storage import open_storage
from tests.made_runs import give_up, make_run

NOBODY = 2**22 + 1  # beyond the largest number that a process can have


def record_of(started: datetime, pid: int, host: str = "") -> JobRecord:
    where = {"host": host or platform.node(), "pid": pid, "address": "local"}
    return JobRecord(id=new_job_id(), command=("datagen", "submit"), started=started.isoformat(), **where)  # type: ignore[arg-type]


def test_a_job_is_dead_when_it_is_silent_and_its_process_is_gone(tmp_path: Path) -> None:
    jobs, at = Jobs(open_storage(tmp_path)), datetime.now(UTC)
    # This process began before now, and long after a job with its number.
    jobs.begin(record_of(at - timedelta(days=3000), os.getpid()))
    assert jobs.all()[0].health(at) == "dead"
    for pid, host, minutes, health in (
        (os.getpid(), "", 0, "live"),
        (os.getpid(), "", 10, "live"),  # it is there, however long it says nothing
        (NOBODY, "", 0.5, "live"),  # not before a minute: hosts of one name are not one host
        (NOBODY, "", 2, "dead"),
        (1, "elsewhere", 0.5, "live"),
        (1, "elsewhere", 2, "silent"),
        # Times ahead: of another machine's clock, and of one that was years ahead when its job was killed.
        (1, "elsewhere", -2, "live"),
        (1, "elsewhere", -1e6, "silent"),
        (NOBODY, "", -1e6, "dead"),
    ):
        record = record_of(at, pid, host)
        jobs.begin(record)
        heard = (at - timedelta(minutes=minutes)).isoformat()
        for end, expected in (("", health), ("complete", "ended")):
            jobs.put_state(JobState(id=record.id, updated=heard, phase="making", end=end))  # type: ignore[arg-type]
            job = jobs.get(record.id)
            assert job is not None and job.health(at) == expected, (pid, minutes)


def test_a_request_to_stop_at_once_is_not_replaced_by_a_weaker_one(tmp_path: Path) -> None:
    jobs, job = Jobs(open_storage(tmp_path)), new_job_id()
    assert jobs.stop_of(job) is None
    for at_once, expected in ((False, "drain"), (True, "now"), (False, "now")):
        jobs.ask_to_stop(job, at_once)
        assert jobs.stop_of(job) == expected


def test_a_torn_state_is_as_if_it_were_absent_and_a_damaged_record_is_named(tmp_path: Path) -> None:
    jobs = Jobs(open_storage(tmp_path))
    record = record_of(datetime.now(UTC), os.getpid())
    jobs.begin(record)
    (tmp_path / f"jobs/{record.id}.state.json").write_bytes(b"")
    (tmp_path / f"jobs/{record.id}.stop").write_bytes(b"")
    (job,) = jobs.all()
    assert job.state is None and job.stop is None and job.record == record
    with pytest.raises(InputError, match="exists already"):
        jobs.begin(record.model_copy(update={"pid": 3}))
    file = tmp_path / f"jobs/{record.id}.json"
    file.write_bytes(file.read_bytes().replace(b"datagen", b"datagex"))
    with pytest.raises(InputError, match=record.id):
        jobs.all()


def test_lifting_keeps_every_record_and_a_cut_lift_is_completed(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", n=50, shards=[0, 2, 4])
    give_up(run, 1, "first")
    give_up(run, 3, "other")
    assert list(run.missing()) == []
    assert lift_quarantine(run) == [1, 3]
    assert list(run.missing()) == [1, 3] and run.quarantined() == set()
    give_up(run, 1, "second")
    # As if a lift had been killed between its two steps.
    here = tmp_path / "run/quarantine"
    (here / "000001.lifted-2.json").write_bytes((here / "000001.json").read_bytes())
    assert lift_quarantine(run) == [1] and lift_quarantine(run) == []
    told = [(record.shard, record.causes[0]) for record in lifted_records(run)]
    assert told == [(1, "first"), (1, "second"), (3, "other")]
    names = {"000001.lifted-1.json", "000001.lifted-2.json", "000003.lifted-1.json"}
    assert {path.name for path in here.iterdir()} == names
