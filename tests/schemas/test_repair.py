"""Repair of what bytes alone do not show; test_damage.py and test_swaps.py damage and repair every file."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.checking import repair
from datagen.schemas.checking.repair import Repaired, repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import commit_key
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from tests.faults.crash_points_operations import remake
from tests.made_runs import files_of, flip, make_run
from tests.schemas.checked import (
    assert_rows,
    folder_of,
    found,
    sealed_run,
    stored,
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


def test_a_sound_run_is_not_changed_and_an_unfinished_one_is_sealed(tmp_path: Path) -> None:
    sealed_run(tmp_path / "sound")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    repaired = repair_at(tmp_path / "sound")
    assert (repaired.restored, repaired.set_aside, repaired.resealed) == ([], [], False)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    run = make_run(tmp_path / "part", 48, shards=[1, 4])
    assert repair_at(folder_of(run)).resealed and (folder_of(run) / "data.zarr/zarr.json").exists()
    for shard in (1, 4):
        flip(folder_of(run) / f"shards/a-{shard}.zip")
    assert [f.kind for f in repair_at(folder_of(run)).left] == ["lost"] and run.committed() == set()


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
