"""Repair of what bytes alone do not show (see test_damage.py and test_swaps.py), and removal of leftovers."""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.checking import repair
from datagen.schemas.checking.repair import Repaired, clean_runs, repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.record_files import commit_key, utc_now
from datagen.schemas.run import Run, open_runs
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage, open_storage
from tests.faults.crash_points_operations import remake
from tests.made_runs import attempt, attempts_of, files_of, flip, make_run, write
from tests.schemas.checked import (
    assert_rows,
    fill,
    folder_of,
    found,
    merge,
    sealed_run,
    stored,
    tree,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("few_arrays")


def repair_at(folder: Path) -> Repaired:
    return repair_runs(open_storage(folder, probe=False, create=False))


def test_a_commit_in_the_place_of_another_leaves_the_shard_that_it_names(tmp_path: Path) -> None:
    run = sealed_run(tmp_path)
    shutil.copy(tmp_path / commit_key(0), tmp_path / commit_key(1))
    repaired = repair_at(tmp_path)
    assert (repaired.set_aside, [f.kind for f in repaired.left]) == ([commit_key(1)], ["lost"])
    assert run.committed() == {0} and run.read_object(run.commit_of(0))
    assert [end.attempt for end in run.ledger.ends()] == ["x-1"]


def test_a_lost_commit_is_made_again_and_the_store_is_kept_meanwhile(tmp_path: Path) -> None:
    run = sealed_run(tmp_path)
    store, rows = files_of(tmp_path / "data.zarr"), stored(run.storage)
    (tmp_path / commit_key(1)).unlink()
    (left,) = repair_at(tmp_path).left
    assert left.kind == "lost" and "datagen resume" in left.fix
    assert files_of(tmp_path / "data.zarr") == store
    remake(folder_of(run))
    assert_rows(stored(run.storage), rows)
    run.grow(39)
    remake(folder_of(run))
    for key in ("plans/2.json", "copies/plans/2.json"):
        (tmp_path / key).unlink()
    (left,) = repair_at(tmp_path).left
    assert left.kind == "stale" and "resume --n" in left.fix and (tmp_path / "data-2.zarr").exists()


def test_an_unfinished_run_is_sealed_and_a_sound_one_is_not_changed(tmp_path: Path) -> None:
    run = make_run(tmp_path, 48, shards=[1, 4])
    assert repair_at(tmp_path).resealed
    before = files_of(tmp_path)
    assert not repair_at(tmp_path).resealed and files_of(tmp_path) == before
    for shard in (1, 4):
        flip(tmp_path / f"shards/a-{shard}.zip")
    assert [f.kind for f in repair_at(tmp_path).left] == ["lost"] and run.committed() == set()


def test_a_store_that_cannot_be_made_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_run(tmp_path, 10)

    def full(*_: Any) -> str:
        raise InputError("the disk", "", "No space left on device", "Free disk space")

    monkeypatch.setattr(repair, "seal", full)
    (left,) = repair_at(tmp_path).left
    assert (left.key, left.kind) == ("data.zarr", "sealed") and "No space left" in left.fix


def test_a_run_on_s3_is_repaired(bucket: str) -> None:
    storage = sealed_run(f"{bucket}/run").storage
    manifest = storage.get("manifest.json", 10**6)
    for key in ("data.zarr/house_id/c.0", "manifest.json", "data.json", "data.zarr/label/c.7"):
        storage.put(key, b"0")
    assert repair_runs(storage).left == [] and found(storage.url) == []
    assert storage.get("manifest.json", 10**6) == manifest
    storage.put("shards/a-1.zip", b"0")
    repaired = repair_runs(storage)
    assert [f.kind for f in repaired.left] == ["lost"] and repaired.set_aside == ["commits/000001.json"]
    assert storage.exists(f"{repaired.into}/shards/a-1.zip")
    assert Run.open(storage).ledger.end_of("a-1").outcome == "superseded"  # type: ignore[union-attr]


def test_a_repair_that_is_interrupted_is_continued_by_the_next(tmp_path: Path) -> None:
    run = sealed_run(tmp_path, 39)
    flip(tmp_path / "shards/a-1.zip")
    plain = Storage.delete

    def dies(storage: Storage, keys: Any) -> None:
        plain(storage, list(keys)[:1])
        raise KeyboardInterrupt

    for _ in range(2):
        with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Storage, "delete", dies)
            repair_at(tmp_path)
    assert [f.kind for f in repair_at(tmp_path).left] == ["lost"] and run.committed() == {0, 2, 3}
    assert list(run.storage.list("shards/a-1.zip")) == []


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
    assert cleaned.files == len(garbage) and cleaned.bytes > 0
    assert tree(run.storage) == before and not (tmp_path / "run" / "data-2.zarr").exists()
    assert len(attempts_of(run)) == 5  # all are kept
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
        for change in (clean_runs, repair_runs):
            with pytest.raises(InputError, match="is running") as refused:
                change(run.storage)
            # Of a machine that is gone nobody can ask.
            assert (f"remove jobs/{record.id}.json" in str(refused.value)) == (host == "elsewhere")
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


def test_parts_of_merged_runs_are_cleaned(tmp_path: Path) -> None:
    for who, seed in (("a", 1), ("b", 2)):
        fill(tmp_path, who, [0], seed=seed)
    merge(tmp_path, "ab")
    storage = open_storage(tmp_path / "out")
    before = tree(storage)
    part = open_runs(storage)[1]
    write(part, 0, "late")
    for key in (f".probe-{'c' * 16}", "data.zarr/x"):
        part.storage.put(key, b"")
    storage.put(f".probe-{'c' * 16}", b"")
    assert clean_runs(storage, kept_s=-60).files == 4 and tree(storage) == before
