"""Removal of leftover files: what records name and young files stay; nothing is removed while a job runs."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from datagen.schemas.checking.cleaning import clean_runs
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.record_files import commit_key, utc_now
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage
from tests.made_runs import attempt, files_of, make_run, write
from tests.schemas.checked import folder_of, found, tree

pytestmark = pytest.mark.usefixtures("few_arrays")
HOUR_S = 3600


def littered(folder: Path | str) -> tuple[Run, set[str]]:
    """A run of five shards, three of them committed, with every kind of garbage; keys of the garbage."""
    run = make_run(folder, n=50, shards=[0, 1, 2])
    attempt(run, 1, "late")  # superseded
    write(run, 3, "never-committed")
    run.ledger.start("never-committed", 3)
    seal(run.storage)
    garbage = {
        f"commits/000007.json.{'a' * 16}.part",
        f"shards/x.zip.{'b' * 16}.part",
        f".probe-{'c' * 16}",
        "data-2.zarr/label/c.0",
        "data-2.zarr/zarr.json",
    }
    for key in garbage:
        run.storage.put(key, b"left behind")
    return run, garbage | {"shards/late.zip", "shards/never-committed.zip"}


def age(run: Run, keys: Iterable[str], seconds: float) -> None:
    then_s = time.time() - seconds
    for key in keys:
        os.utime(folder_of(run) / key, (then_s, then_s))


def without(storage: Storage, garbage: Iterable[str]) -> dict[str, bytes | None]:
    return {key: data for key, data in tree(storage).items() if key not in set(garbage)}


@pytest.mark.parametrize("place", ["disk", "s3"])
def test_garbage_is_removed_and_all_else_keeps_its_bytes(place: str, tmp_path: Path, bucket: str) -> None:
    run, garbage = littered(tmp_path / "run" if place == "disk" else f"{bucket}/run")
    before = without(run.storage, garbage)
    cleaned = clean_runs(run.storage, kept_s=-HOUR_S)
    assert (cleaned.files, cleaned.attempts) == (len(garbage), 2) and cleaned.bytes > 0
    assert tree(run.storage) == before and not (tmp_path / "run" / "data-2.zarr").exists()
    assert len(run.ledger.attempts()) == 5  # all are kept
    assert clean_runs(run.storage, kept_s=-HOUR_S).files == 0 and found(run.storage.url) == []


def test_files_of_the_last_hour_and_stores_that_are_being_written_are_kept(tmp_path: Path) -> None:
    run, garbage = littered(tmp_path)
    before = files_of(tmp_path)
    assert clean_runs(run.storage).files == 0 and files_of(tmp_path) == before
    age(run, files_of(tmp_path), 2 * HOUR_S)
    young = {"shards/late.zip", "data-2.zarr/zarr.json"}
    age(run, young, 60)
    clean_runs(run.storage)
    assert files_of(tmp_path).keys() == before.keys() - garbage | young | {"data-2.zarr/label/c.0"}


@pytest.mark.parametrize(
    ("host", "age_h", "is_alive"),
    [
        ("h", 0, True),
        ("elsewhere", 2, True),
        ("elsewhere", 48, False),
        # Killed with its clock three years ahead.
        ("elsewhere", -26_000, False),
        (platform.node(), -26_000, False),
    ],
)
def test_nothing_is_removed_while_a_job_may_be_alive(
    host: str, age_h: int, is_alive: bool, tmp_path: Path
) -> None:
    run, garbage = littered(tmp_path)
    before, jobs = files_of(tmp_path), Jobs(run.storage)
    began = (datetime.now(UTC) - timedelta(hours=age_h)).isoformat()
    record = JobRecord(id=new_job_id(), command=(), host=host, pid=2**22 + 1, started=began, address="local")
    jobs.begin(record)
    (tmp_path / "jobs/20200101T000000-00000000.json").write_bytes(b"damaged")
    if is_alive:
        with pytest.raises(InputError, match="is running"):
            clean_runs(run.storage, kept_s=-60)
        assert files_of(tmp_path).items() >= before.items()
        jobs.put_state(JobState(id=record.id, updated=utc_now(), phase="ended", end="complete"))
    assert clean_runs(run.storage, kept_s=-60).files == len(garbage)


def test_nothing_is_removed_where_a_damaged_record_may_name_it(tmp_path: Path) -> None:
    run, _ = littered(tmp_path)
    for key in (commit_key(0), "data.json"):
        whole = (tmp_path / key).read_bytes()
        (tmp_path / key).write_bytes(b"{}")
        with pytest.raises(InputError, match=key):
            clean_runs(run.storage, kept_s=-60)
        assert all((tmp_path / name).exists() for name in ("shards/a-0.zip", "data.zarr/zarr.json"))
        (tmp_path / key).write_bytes(whole)
