"""`datagen repair` on real runs: only what is bad is made again, and only as it was."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zarr

from datagen import cli
from datagen.schemas.checking.repair import repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.keys import MERGED, part_folder
from datagen.schemas.record_files import encode_record, signed_json
from datagen.schemas.run import Run
from datagen.schemas.run_records import Merged
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from tests.faults.damage_campaign import Damage, apply, copy_run, fewer_arrays, make_place, regenerate
from tests.made_runs import files_of, make_run, small_spec


def damage(run: Path, pattern: str) -> str:
    """Change one byte of the first file of that pattern; its key."""
    key = str(sorted(run.glob(pattern))[0].relative_to(run))
    apply(run, Damage("", key, lambda data: data[:-1] + bytes([data[-1] ^ 1])))
    return key


def repaired(run: Path, capture: pytest.CaptureFixture[str], code: int, *more: str) -> dict[str, Any]:
    """What repair says, with the exit code that it must have."""
    capture.readouterr()
    assert cli.run(["repair", str(run), "--json", *more]) == code
    return json.loads(capture.readouterr().out)


def test_damage_is_undone_to_the_last_byte_and_nothing_else_is_touched(
    finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = files_of(finished)
    shard = damage(copied, "shards/000001/*/rgb/c.0.0.0")
    metadata = damage(copied, "shards/000000/*/label/zarr.json")
    records = [damage(copied, f"{key}") for key in ("manifest.json", "commits/000000.json", "plans/1.json")]
    (copied / "copies/manifest.json").write_bytes(whole["copies/manifest.json"])
    times = {p: p.stat().st_mtime_ns for p in copied.rglob("*") if p.is_file()}
    report = repaired(copied, capsys, 0)
    assert report["records"] == sorted(records)
    assert (report["files_made_again"], report["shards_made_again"]) == ([shard], [1])
    assert report["files_from_copies"] == [metadata]
    assert (report["sealed_anew"], report["files_changed_by_others"], report["left"]) == (True, [], [])
    assert files_of(copied) == whole
    touched = {str(p.relative_to(copied)) for p, time in times.items() if p.stat().st_mtime_ns != time}
    assert {key for key in touched if not key.startswith("data.zarr/")} == {shard, metadata, *records}
    again = repaired(copied, capsys, 0)
    assert not any(again[k] for k in ("records", "files_made_again", "files_from_copies", "sealed_anew"))
    assert cli.run(["verify", str(copied)]) == 0


def test_a_shard_that_comes_out_otherwise_is_refused_and_left(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commit has a digest that this machine does not give: another one made it."""
    key = damage(copied, "shards/000001/*/rgb/c.0.0.0")
    commit = Run.open(copied).commit_of(1)
    record = commit.model_dump(mode="json")
    for entry in record["files"]:
        if entry["path"] == "rgb/c.0.0.0":
            entry["sha256"] = "0" * 64
    for name in ("commits/000001.json", f"shards/000001/{commit.attempt}/commit.json"):
        (copied / name).write_bytes(signed_json(record))
    before = files_of(copied / "shards")
    report = repaired(copied, capsys, 1)
    (left,) = [f for f in report["left"] if f["kind"] == "file"]
    assert left["file"] == key and "other bytes" in left["fix"] and report["files_made_again"] == []
    assert files_of(copied / "shards") == before
    assert cli.run(["repair", str(copied)]) == 1
    assert "differs here" in capsys.readouterr().out


def test_sources_that_have_moved_are_named(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage(copied, "shards/000001/*/rgb/c.0.0.0")
    report = repaired(copied, capsys, 1, "--houses", "builtin:3")
    assert any("builtin:3" in f["fix"] for f in report["left"])
    assert repaired(copied, capsys, 0)["clean"]


def test_several_processes_make_shards_again(
    finished: Path, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = [damage(copied, f"shards/00000{k}/*/rgb/c.0.0.0") for k in (0, 2)]
    report = repaired(copied, capsys, 0, "--workers", "1")
    assert report["files_made_again"] == sorted(keys)
    assert files_of(copied) == files_of(finished)


# Made-up runs: how repair goes about it ---------------------------------------------------------


def test_an_interrupted_repair_is_finished_by_the_next(tmp_path: Path) -> None:
    make_place(tmp_path / "clean", 39)
    copy_run(tmp_path / "clean", tmp_path / "run")
    keys = [damage(tmp_path / "run", f"shards/00000{k}/*/label/c.0") for k in range(4)]

    def break_off(run: Run, shard: int) -> Any:
        if shard == 2:
            raise KeyboardInterrupt
        return regenerate(run, shard)

    place = open_storage(tmp_path / "run", probe=False)
    with pytest.raises(KeyboardInterrupt):
        repair_runs(place, break_off)
    repaired = repair_runs(place, regenerate)
    assert repaired.regenerated_files == keys[2:] and repaired.left == []
    assert files_of(tmp_path / "run") == files_of(tmp_path / "clean")


def test_a_failing_simulator_leaves_its_shard_and_others_are_repaired(tmp_path: Path) -> None:
    make_place(tmp_path / "run", 39)
    keys = [damage(tmp_path / "run", f"shards/00000{k}/*/label/c.0") for k in range(3)]

    def fail(run: Run, shard: int) -> Any:
        if shard == 1:
            raise RuntimeError("the physics left sense")
        return regenerate(run, shard)

    repaired = repair_runs(open_storage(tmp_path / "run", probe=False), fail, workers=2)
    assert sorted(repaired.regenerated_files) == [keys[0], keys[2]]
    assert {f.key for f in repaired.left if f.kind == "file"} == {keys[1]}
    assert any("left sense" in f.fix for f in repaired.left)


def test_a_deleted_chunk_comes_back_from_the_sealed_store(tmp_path: Path) -> None:
    make_place(tmp_path / "clean", 19)
    copy_run(tmp_path / "clean", tmp_path / "run")
    key = "shards/000001/a-1/points_m/c.0.0.0"
    (tmp_path / "run" / key).unlink()

    def never(run: Run, shard: int) -> Any:
        raise AssertionError("there was a second source")

    repaired = repair_runs(open_storage(tmp_path / "run", probe=False), never)
    assert repaired.copied_files == [key] and repaired.left == []
    assert files_of(tmp_path / "run") == files_of(tmp_path / "clean")
    assert (tmp_path / "run" / key).samefile(tmp_path / "run/data.zarr/points_m/c.1.0.0")


def test_what_cannot_be_repaired_is_left_and_said(tmp_path: Path) -> None:
    run = make_place(tmp_path / "run", 19)
    (tmp_path / "run/ledger/b-0.json").write_bytes(b"")
    for key in ("commits/000001.json", "shards/000001/a-1/commit.json", "ledger/a-1.json"):
        (tmp_path / "run" / key).unlink()
    repaired = repair_runs(run.storage, regenerate)
    assert {(f.kind, f.key) for f in repaired.left if f.is_damage} == {
        ("account", "ledger/b-0.json"),
        ("lost", "commits/000001.json"),
        ("sealed", "data.zarr"),
    }
    assert zarr.open_array(tmp_path / "run/data.zarr/label", mode="r").shape[0] == 19
    with pytest.raises(InputError):
        run.commit_of(1)


def test_the_parts_of_a_merged_place_are_repaired(tmp_path: Path) -> None:
    specs = sorted((small_spec(seed) for seed in (1, 2)), key=lambda spec: spec.hash())
    for spec in specs:
        make_run(tmp_path / "clean" / part_folder(spec.hash()), 20, spec=spec)
    storage = open_storage(tmp_path / "clean")
    for key in (MERGED, f"copies/{MERGED}"):
        storage.put(key, encode_record(Merged(parts=tuple(spec.hash() for spec in specs))))
    seal(storage)
    copy_run(tmp_path / "clean", tmp_path / "run")
    part = part_folder(specs[1].hash())
    chunk = damage(tmp_path / "run", f"{part}/shards/000001/*/label/c.0")
    records = [damage(tmp_path / "run", key) for key in (f"{part}/commits/000000.json", MERGED)]
    sealed = damage(tmp_path / "run", "data.zarr/zarr.json")
    repaired = repair_runs(open_storage(tmp_path / "run", probe=False), regenerate)
    assert sorted(repaired.records) == sorted(records) and repaired.regenerated_files == [chunk]
    assert repaired.resealed and repaired.left == [] and repaired.changed == []
    assert files_of(tmp_path / "run") == files_of(tmp_path / "clean"), sealed


def test_a_relabelled_run_is_repaired_after_the_one_whose_scenes_it_shares(
    finished: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = tmp_path / "again"
    assert cli.run(["relabel", str(copied), "--out", str(again), "--mu", "0.5"]) == 0
    whole = files_of(again)
    shared = damage(again, "shards/000001/*/rgb/c.0.0.0")
    damage(again, "shards/000002/*/heuristic_score/c.0")  # relabelling wrote this one
    assert [f["file"] for f in repaired(again, capsys, 1)["left"] if f["kind"] == "file"] == [shared]
    assert repaired(copied, capsys, 0)["shards_made_again"] == [1]
    assert repaired(again, capsys, 0)["shards_made_again"] == [1]
    assert files_of(again) == whole and files_of(copied) == files_of(finished)


@pytest.fixture
def quick() -> Iterator[None]:
    """Runs of few files."""
    with fewer_arrays():
        yield


@pytest.mark.usefixtures("quick")
def test_a_run_on_s3_is_checked_and_repaired(bucket: str) -> None:
    run = make_place(f"{bucket}/run", 19)
    storage = run.storage
    whole = {f.key: storage.get(f.key, 2**30) for f in storage.list("")}
    for key in ("shards/000001/a-1/points_m/c.0.0.0", "data.zarr/house_id/c.0", "manifest.json"):
        data = whole[key]
        assert data is not None
        storage.put(key, data[:-1] + b"\0")
    storage.delete(["data.zarr/label/zarr.json", "shards/000000/a-0/label/c.0", "commits/000000.json"])
    storage.put("data.zarr/label/c.7", b"")
    repaired = repair_runs(storage, regenerate)
    assert (
        repaired.left == [] and repaired.regenerated_files == []
    )  # the sealed store holds copies of its own
    assert {f.key: storage.get(f.key, 2**30) for f in storage.list("")} == whole
    storage.delete(["data.zarr/zarr.json"])
    storage.put("shards/000001/a-1/points_m/c.0.0.0", b"0")
    storage.put("data.zarr/points_m/c.1.0.0", b"0")
    repaired = repair_runs(storage, regenerate)
    assert repaired.left == [] and repaired.regenerated_shards == [1] and repaired.resealed
