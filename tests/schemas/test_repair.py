"""Repair restores records and sets shards aside; a resumed run then has the bytes of the undamaged one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.checking import repair
from datagen.schemas.checking.finding import Finding
from datagen.schemas.checking.repair import repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobRecord, Jobs, new_job_id
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.record_files import (
    MAX_RECORD_BYTES,
    MERGED,
    commit_copy_key,
    commit_key,
    encode_record,
    part_folder,
    utc_now,
)
from datagen.schemas.run_records import Cost, LedgerEntry
from datagen.schemas.storage import open_storage
from tests.faults.damage_campaign import (
    Damage,
    apply,
    content,
    copy_run,
    fewer_arrays,
    findings_at,
    make_place,
    remake,
    repair_at,
)
from tests.made_runs import files_of, make_run, small_spec, write


@pytest.fixture(autouse=True)
def quick() -> Iterator[None]:
    """Runs of few files."""
    with fewer_arrays():
        yield


def damage(run: Path, pattern: str) -> str:
    """Change one byte of the first file of that pattern; its key."""
    key = str(sorted(run.glob(pattern))[0].relative_to(run))
    apply(run, Damage("", key, lambda data: data[:-1] + bytes([data[-1] ^ 1])))
    return key


@pytest.mark.parametrize("kind", ["run", "merged", "parts"])
def test_repair_and_resume_give_the_bytes_of_the_undamaged_run(kind: str, tmp_path: Path) -> None:
    clean, folder, part = tmp_path / "clean", tmp_path / "run", ""
    if kind == "run":
        make_place(clean, 39)
    else:  # shards of one run that are linked and cut, or two runs of different specifications
        seeds = (1, 1) if kind == "merged" else (1, 2)
        for name, seed, size, shards in (("a", seeds[0], 2, [0, 1]), ("b", seeds[1], 4, [1])):
            make_run(tmp_path / name, 40, size, shards=shards, spec=small_spec(seed))
        merge_runs(plan_merge([f"{tmp_path}/a", f"{tmp_path}/b"], str(clean)))
        part = f"{part_folder(small_spec(1).hash())}/" if kind == "parts" else ""
        remake(clean)
    copy_run(clean, folder)
    shard = damage(folder, f"{part}shards/000001/*/label/c.0")
    records = [damage(folder, f"{part}commits/000000.json"), damage(folder, f"{part}manifest.json")]
    damage(folder, "data.zarr/zarr.json")
    repaired = repair_at(folder)
    assert sorted(repaired.restored) == sorted(records) and repaired.resealed and repaired.left == []
    assert repaired.set_aside == [f"{part}shards/000001"] and findings_at(folder) == []
    assert (folder / repaired.into / shard).exists() and not (folder / shard).exists()
    remake(folder)
    assert content(folder) == content(clean) and findings_at(folder) == []
    assert repair_at(folder).set_aside == []  # nothing is left to do


def test_a_sound_run_is_not_changed(tmp_path: Path) -> None:
    make_place(tmp_path, 19)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    repaired = repair_at(tmp_path)
    assert (repaired.restored, repaired.set_aside, repaired.resealed) == ([], [], False)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_an_unfinished_run_is_sealed(tmp_path: Path) -> None:
    make_run(tmp_path, 48, shards=[1, 4])
    assert repair_at(tmp_path).resealed and (tmp_path / "data.zarr/zarr.json").exists()
    for shard in (1, 4):
        damage(tmp_path, f"shards/{shard:06d}/*/label/c.0")
    assert repair_at(tmp_path).left == [] and not (tmp_path / "data.zarr").exists()  # nothing is committed


def test_a_store_that_cannot_be_made_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_run(tmp_path, 10)

    def full(*_: Any) -> str:
        raise InputError("the disk", "", "No space left on device", "Free disk space")

    monkeypatch.setattr(repair, "seal", full)
    (left,) = repair_at(tmp_path).left
    assert (left.key, left.kind) == ("data.zarr", "sealed") and "No space left" in left.fix


def test_repair_is_refused_while_a_job_may_be_alive(tmp_path: Path) -> None:
    run = make_place(tmp_path, 19)
    record = JobRecord(id=new_job_id(), command=(), host="h", pid=1, started=utc_now(), address="local")
    Jobs(run.storage).begin(record)
    with pytest.raises(InputError, match="is running"):
        repair_runs(run.storage)


def test_a_missing_end_record_does_not_replace_one_that_is_written_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path, 20)
    for name in ("slow", "lost"):
        run.ledger.start(name, 0)
    account = LedgerEntry(attempt="slow", shard=0, outcome="superseded", cost=Cost(wall_s=7, cpu_s=5))
    check = repair.check_runs

    def and_the_driver_continues(*arguments: Any) -> Iterator[Finding]:
        for finding in check(*arguments):
            if finding.key == "ledger/slow.json":
                assert run.ledger.end(account)
            yield finding

    monkeypatch.setattr(repair, "check_runs", and_the_driver_continues)
    assert repair_runs(run.storage).left == [] and run.ledger.end_of("slow") == account
    end = run.ledger.end_of("lost")
    assert end is not None and end.outcome == "lost"


def test_of_several_copies_that_of_the_committed_attempt_restores_a_commit(tmp_path: Path) -> None:
    run = make_run(tmp_path, 20)
    for name in ("0-first", "z-last"):  # superseded attempts that were killed before they removed theirs
        run.storage.put(commit_copy_key(1, name), encode_record(write(run, 1, name)))
    whole = run.storage.get(commit_key(1), MAX_RECORD_BYTES)
    run.storage.delete([commit_key(1)])
    repaired = repair_runs(run.storage)
    assert (repaired.restored, repaired.left) == ([commit_key(1)], [])
    assert run.storage.get(commit_key(1), MAX_RECORD_BYTES) == whole


def test_records_without_a_copy_are_set_aside_and_lost_plans_keep_the_store(tmp_path: Path) -> None:
    run = make_place(tmp_path, 9)
    run.grow(19)
    remake(tmp_path)
    store, name = files_of(tmp_path / "data.zarr"), run.commit_of(1).attempt
    (tmp_path / "ledger/b-0.json").write_bytes(b"")
    for key in (commit_key(1), commit_copy_key(1, name), f"ledger/{name}.json"):
        (tmp_path / key).unlink()
    repaired = repair_at(tmp_path)
    assert repaired.left == [] and sorted(repaired.set_aside) == ["ledger/b-0.json", "shards/000001"]
    remake(tmp_path)
    assert files_of(tmp_path / "data.zarr") == store
    for key in ("plans/2.json", "copies/plans/2.json"):
        (tmp_path / key).unlink()
    (left,) = repair_at(tmp_path).left
    assert left.kind == "sealed" and "resume --n" in left.fix
    assert files_of(tmp_path / "data.zarr") == store


def test_a_run_on_s3_is_repaired(bucket: str) -> None:
    run = make_place(f"{bucket}/run", 19)
    storage = run.storage
    whole = {f.key: storage.get(f.key, 2**30) for f in storage.list("")}
    for key in ("data.zarr/house_id/c.0", "manifest.json"):
        storage.put(key, (whole[key] or b"")[:-1] + b"\0")
    storage.delete(["data.zarr/label/zarr.json", "commits/000000.json"])
    storage.put("data.zarr/label/c.7", b"")
    assert repair_runs(storage).left == []
    assert {f.key: storage.get(f.key, 2**30) for f in storage.list("")} == whole
    storage.put("shards/000001/a-1/points_m/c.0.0.0", b"0")
    repaired = repair_runs(storage)
    assert repaired.left == [] and repaired.set_aside == ["shards/000001"] and run.committed() == {0}
    assert storage.exists(f"{repaired.into}/commits/000001.json")


def test_the_record_of_merged_runs_is_restored(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        make_run(tmp_path / name, 10, spec=small_spec(seed))
    merge_runs(plan_merge([f"{tmp_path}/a", f"{tmp_path}/b"], f"{tmp_path}/out"))
    before = files_of(tmp_path / "out")
    (tmp_path / "out" / MERGED).unlink()
    assert repair_runs(open_storage(tmp_path / "out")).restored == [MERGED]
    assert files_of(tmp_path / "out") == before
