"""Removal of leftover files: committed and young files stay, and nothing is removed while a job runs."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.checking.cleaning import clean_runs
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.record_files import (
    MERGED,
    commit_copy_key,
    commit_key,
    encode_record,
    part_folder,
    shard_folder,
    utc_now,
)
from datagen.schemas.run import Run
from datagen.schemas.run_records import Merged
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage, open_storage
from tests.made_runs import attempt, check_digests, files_of, make_run, small_spec, write

HOUR_S = 3600


def littered(folder: Path | str) -> tuple[Run, set[str]]:
    """A run of five shards, three of them committed, with every kind of garbage; keys of the garbage."""
    run = make_run(folder, n=50, shards=[0, 1, 2])
    attempt(run, 1, "late")  # superseded
    write(run, 3, "never-committed")
    run.ledger.start("never-committed", 3)
    seal(run.storage)
    keys = {
        f"commits/000007.json.{'a' * 16}.part",
        f"{shard_folder(0, 'a-0')}/zarr.json.{'b' * 16}.part",
        f".probe-{'c' * 16}",
        f"data.zarr.{'d' * 16}.partial/label/c.0",
    }
    for key in keys:
        run.storage.put(key, b"left behind")
    for name in (shard_folder(1, "late"), shard_folder(3, "never-committed")):
        keys |= {file.key for file in run.storage.list(name)}
    return run, keys


def age(run: Run, keys: Iterable[str], seconds: float) -> None:
    for key in keys:
        os.utime(Path(run.storage.url, key), (time.time() - seconds,) * 2)


def kept(folder: Path, garbage: Iterable[str] = ()) -> dict[str, bytes]:
    return {k: data for k, data in files_of(folder).items() if k not in set(garbage)}


def test_garbage_is_removed_and_everything_else_keeps_its_bytes(tmp_path: Path) -> None:
    run, garbage = littered(tmp_path)
    before = kept(tmp_path, garbage)
    cleaned = clean_runs(run.storage, kept_s=-60)
    assert (cleaned.files, cleaned.attempts) == (len(garbage), 2) and cleaned.bytes > 0
    assert kept(tmp_path) == before
    assert not (tmp_path / shard_folder(1, "late")).exists() and not list(tmp_path.glob("data.zarr.*"))
    check_digests(run, run.commit_of(0))
    assert len(list(run.ledger.ends())) == 4  # the ledger keeps them all
    assert clean_runs(run.storage, kept_s=-60).files == 0


def test_files_of_the_last_hour_are_kept(tmp_path: Path) -> None:
    run, _ = littered(tmp_path)
    before = kept(tmp_path)
    assert clean_runs(run.storage).files == 0 and kept(tmp_path) == before
    age(run, [file.key for file in run.storage.list("")], 2 * HOUR_S)
    age(run, [f"{shard_folder(1, 'late')}/zarr.json", "ledger/never-committed.start.json"], 60)
    clean_runs(run.storage)
    left = kept(tmp_path)
    assert f"{shard_folder(1, 'late')}/label/c.0" in left
    assert f"{shard_folder(3, 'never-committed')}/label/c.0" in left
    assert f".probe-{'c' * 16}" not in left


@pytest.mark.parametrize(
    ("host", "age_h", "is_alive"), [("h", 0, True), ("elsewhere", 2, True), ("elsewhere", 48, False)]
)
def test_nothing_is_removed_while_a_job_may_be_alive(
    host: str, age_h: int, is_alive: bool, tmp_path: Path
) -> None:
    run, garbage = littered(tmp_path)
    before, jobs = files_of(tmp_path), Jobs(run.storage)
    began = (datetime.now(UTC) - timedelta(hours=age_h)).isoformat()
    record = JobRecord(id=new_job_id(), command=(), host=host, pid=1, started=began, address="local")
    jobs.begin(record)
    (tmp_path / "jobs/20200101T000000-00000000.json").write_bytes(b"damaged")
    if is_alive:
        with pytest.raises(InputError, match="is running"):
            clean_runs(run.storage, kept_s=-60)
        assert files_of(tmp_path).items() >= before.items()
        jobs.put_state(JobState(id=record.id, updated=utc_now(), phase="ended", end="complete"))
    assert clean_runs(run.storage, kept_s=-60).files == len(garbage)


def test_an_attempt_that_a_lost_commit_may_name_is_kept(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=50, shards=[0, 1])
    run.storage.delete([commit_key(1)])
    (tmp_path / commit_key(0)).write_bytes(b"{}")
    write(run, 0, "other")
    assert clean_runs(run.storage, kept_s=-60).files == 0
    assert run.storage.exists(commit_copy_key(1, "a-1"))


def test_an_attempt_whose_files_were_removed_cannot_be_committed(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=20, shards=[])
    commit = write(run, 0, "slow")
    clean_runs(run.storage, kept_s=-60)
    with pytest.raises(InputError, match="is missing"):
        run.commit(commit)
    assert run.committed() == set() and attempt(run, 0, "next")


def test_an_interrupted_removal_is_completed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, garbage = littered(tmp_path)
    before, plain = kept(tmp_path, garbage), Storage.delete

    def dies(storage: Storage, keys: Any) -> None:
        some = list(keys)
        plain(storage, some[: len(some) // 2])
        if some:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Storage, "delete", dies)
        clean_runs(run.storage, kept_s=-60)
    clean_runs(run.storage, kept_s=-60)
    assert kept(tmp_path) == before


def test_merged_runs_and_runs_on_s3_are_cleaned_as_on_a_disk(tmp_path: Path, bucket: str) -> None:
    run, garbage = littered(f"{bucket}/run")
    assert clean_runs(run.storage, kept_s=-3600).files == len(garbage)
    specs = sorted((small_spec(seed) for seed in (1, 2)), key=lambda spec: spec.hash())
    parts = [make_run(tmp_path / part_folder(spec.hash()), 10, spec=spec) for spec in specs]
    storage = open_storage(tmp_path)
    storage.put(MERGED, encode_record(Merged(parts=tuple(spec.hash() for spec in specs))))
    write(parts[0], 0, "late")
    storage.put(f".probe-{'c' * 16}", b"")
    before = kept(tmp_path, [f".probe-{'c' * 16}"])
    clean_runs(storage, kept_s=-60)
    assert kept(tmp_path) == {k: v for k, v in before.items() if "/late/" not in k}
