"""What checks find among the records of a run, and that they find nothing in a sound one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.checking.finding import Restore, SetAside
from datagen.schemas.checking.repair import repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import (
    MERGED,
    commit_copy_key,
    commit_key,
    encode_record,
    part_folder,
    signed_json,
)
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, Merged, Plan, QuarantineRecord
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from tests.faults.damage_campaign import fewer_arrays
from tests.made_runs import attempt, make_run, small_spec
from tests.schemas.checked import check, edit, folder_of, found, sealed_run


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Runs of few files."""
    with fewer_arrays():
        yield


@pytest.fixture
def sealed(tmp_path: Path) -> Run:
    return sealed_run(tmp_path / "run")


def test_a_sound_run_has_no_findings_and_its_numbers_are_told(sealed: Run):
    findings, checked = check(folder_of(sealed))
    assert findings == []
    assert (checked.shards, checked.samples, checked.is_sealed) == (2, 20, True)
    assert checked.files == sum(len(c.files) for c in sealed.commits())
    totals = checked.totals
    assert (totals.attempts, totals.committed_wall_s, totals.wasted_wall_s) == (3, 2.0, 2.0)


def test_unfinished_unsealed_and_empty_runs_are_sound(tmp_path: Path):
    run = make_run(tmp_path / "a", 50, shards=[0, 3])
    run.ledger.start("runs-now", 1)
    assert found(tmp_path / "a") == []
    assert check(tmp_path / "a")[1].totals.unfinished == 1
    make_run(tmp_path / "b", 50, shards=[])
    assert found(tmp_path / "b") == []


def test_what_is_no_run_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="not a run"):
        check(tmp_path)
    run = make_run(tmp_path / "run", 10)
    for key in ("manifest.json", "copies/manifest.json"):
        edit(folder_of(run) / key, format_version=99)
    with pytest.raises(InputError, match="99"):
        check(folder_of(run))


def test_a_seal_that_is_behind_is_told_and_is_no_damage(sealed: Run):
    sealed.grow(40)
    findings, _ = check(folder_of(sealed))
    assert [(f.kind, f.is_damage) for f in findings] == [("stale", False)]
    attempt(sealed, 2, "a-2")
    assert found(folder_of(sealed)) == [("stale", "data.zarr")]


@pytest.mark.parametrize("key", ["manifest.json", "plans/1.json"])
@pytest.mark.parametrize("copies", ["", "copies/"])
def test_root_records_and_their_copies_restore_each_other(sealed: Run, key: str, copies: str):
    path = folder_of(sealed) / f"{copies}{key}"
    whole = path.read_bytes()
    for damage in (path.unlink, lambda: path.write_bytes(whole[:-1]), lambda: path.write_bytes(b"")):
        damage()
        (finding,), _ = check(folder_of(sealed))
        assert (finding.kind, finding.key, finding.cure) == ("record", f"{copies}{key}", Restore(whole))
        path.write_bytes(whole)


def test_records_that_are_signed_but_differ_from_their_copies_are_found(sealed: Run):
    folder = folder_of(sealed)
    edit(folder / "manifest.json", code_version="9")
    edit(folder / "plans/1.json", created="now")
    edit(folder / commit_key(1), created="now")
    expected = [("record", "manifest.json"), ("record", "plans/1.json"), ("record", commit_key(1))]
    findings, _ = check(folder)
    assert [(f.kind, f.key) for f in findings if f.kind == "record"] == expected
    assert all(f.cure is None for f in findings if f.kind == "record")


def test_records_that_are_signed_but_laid_out_otherwise_are_found(sealed: Run):
    path = folder_of(sealed) / "ledger/x-1.json"
    record = json.loads(path.read_text())
    del record["sha256"]
    path.write_bytes(signed_json(dict(reversed(record.items()))))
    assert found(folder_of(sealed)) == [("account", "ledger/x-1.json")]


def test_plans_that_are_gone_or_shrink(tmp_path: Path):
    run = make_run(tmp_path / "run", 10)
    run.grow(20)
    run.grow(30)
    folder = folder_of(run)
    for key in ("plans/2.json", "copies/plans/2.json"):
        (folder / key).unlink()
    assert found(folder) == [("record", "plans/2.json")]
    for key in ("plans/2.json", "copies/plans/2.json"):
        (folder / key).write_bytes((folder / "plans/1.json").read_bytes())
    assert found(folder) == [("record", "plans/2.json"), ("record", "copies/plans/2.json")]
    shrunk = Plan(n=10, created="", spec_hash=run.manifest.spec_hash, number=2)
    for key in ("plans/2.json", "copies/plans/2.json"):
        (folder / key).write_bytes(encode_record(shrunk))
    assert found(folder) == [("record", "plans/2.json")]


# Commits -----------------------------------------------------------------------------------------


def test_a_deleted_commit_is_known_from_the_sealed_store_or_the_ledger(sealed: Run):
    folder = folder_of(sealed)
    whole = (folder / commit_key(1)).read_bytes()
    (folder / commit_key(1)).unlink()
    (finding,), _ = check(folder)
    assert (finding.key, finding.cure) == (commit_key(1), Restore(whole))
    shutil.rmtree(folder / "data.zarr")
    (finding,), _ = check(folder)
    assert (finding.key, finding.cure) == (commit_key(1), Restore(whole))


def test_a_commit_that_is_gone_with_its_copy_leaves_an_open_shard(sealed: Run):
    folder = folder_of(sealed)
    shutil.rmtree(folder / "data.zarr")
    for key in (commit_key(1), commit_copy_key(1, "a-1")):
        (folder / key).unlink()
    (finding,), _ = check(folder)
    assert (finding.kind, finding.key) == ("lost", commit_key(1)) and isinstance(finding.cure, SetAside)
    attempt(sealed, 1, "again")
    assert found(folder) == []


def test_of_several_copies_the_one_that_the_ledger_names_counts(sealed: Run):
    folder = folder_of(sealed)
    right = (folder / commit_key(1)).read_bytes()
    loser = sealed.commit_of(1).model_copy(update={"attempt": "x-1"})
    (folder / "shards/000001/x-1").mkdir()
    (folder / commit_copy_key(1, "x-1")).write_bytes(encode_record(loser))
    assert found(folder) == []  # what a killed loser leaves
    (folder / commit_key(1)).write_bytes(right[:-9])
    (finding,), _ = check(folder)
    assert (finding.key, finding.cure) == (commit_key(1), Restore(right))


@pytest.mark.parametrize(
    "changes", [{"shard": 0}, {"spec_hash": "0" * 64}, {"scenes": 1}, {"samples": 3}, {"format_version": "x"}]
)
def test_a_commit_that_cannot_be_this_shards_gives_way_to_its_copy(sealed: Run, changes: dict[str, Any]):
    folder = folder_of(sealed)
    whole = (folder / commit_key(1)).read_bytes()
    edit(folder / commit_key(1), **changes)
    (finding,), _ = check(folder)
    assert (finding.key, finding.cure) == (commit_key(1), Restore(whole))


# Ledger ------------------------------------------------------------------------------------------


def test_ends_and_starts_of_committed_attempts_come_from_their_commits(sealed: Run):
    folder = folder_of(sealed)
    start, end = folder / "ledger/a-0.start.json", folder / "ledger/a-0.json"
    for path in (start, end):
        whole = path.read_bytes()
        path.unlink()
        (finding,), _ = check(folder)
        assert finding.kind == "account" and isinstance(finding.cure, Restore)
        path.write_bytes(finding.cure.data)
        assert found(folder) == []
        path.write_bytes(whole)


def test_an_account_that_is_not_its_commits(sealed: Run):
    folder = folder_of(sealed)
    edit(folder / "ledger/a-0.json", outcome="failed")
    assert found(folder) == [("account", "ledger/a-0.json")]
    edit(folder / "ledger/a-0.json", outcome="committed", cost={"wall_s": 9, "cpu_s": 1})
    assert ("account", "ledger/a-0.json") in found(folder)


def test_an_end_without_a_start_and_a_start_of_a_decided_shard_without_an_end(sealed: Run):
    folder = folder_of(sealed)
    (folder / "ledger/x-1.start.json").unlink()
    (finding,), _ = check(folder)
    assert (finding.key, finding.kind) == ("ledger/x-1.start.json", "account")
    assert finding.cure is not None
    sealed.ledger.start("x-1", 1)
    (folder / "ledger/x-1.json").unlink()
    (finding,), _ = check(folder)
    assert (finding.key, finding.kind) == ("ledger/x-1.json", "account")


def test_a_damaged_end_record_without_a_commit_is_set_aside(sealed: Run):
    (folder_of(sealed) / "ledger/x-1.json").write_bytes(b"{}")
    (finding,), _ = check(folder_of(sealed))
    assert (finding.kind, finding.cure) == ("account", SetAside())


def test_stages_that_take_longer_than_their_attempt(sealed: Run):
    cost = Cost(wall_s=2.0, cpu_s=1.0, stage_wall_s={"draw": 1.5, "settle": 1.0}).model_dump(mode="json")
    edit(folder_of(sealed) / "ledger/x-1.json", cost=cost)
    (finding,), _ = check(folder_of(sealed))
    assert finding.kind == "account" and "2.5 s" in finding.problem


def test_a_quarantine_record_that_is_damaged_or_of_another_shard(sealed: Run):
    sealed.grow(60)
    record = QuarantineRecord(
        shard=4, seed=0, first_scene=8, scenes=2, attempts=(), causes=(), stacks=(), created=""
    )
    sealed.quarantine(record)
    assert [f for f in check(folder_of(sealed))[0] if f.is_damage] == []
    path = folder_of(sealed) / "quarantine/000004.json"
    path.rename(path.with_name("000005.json"))
    assert ("record", "quarantine/000005.json") in found(folder_of(sealed))


# Sealed store ------------------------------------------------------------------------------------


def test_files_of_the_sealed_store(sealed: Run):
    store = folder_of(sealed) / "data.zarr"
    chunk = store / "label/c.1"
    data = chunk.read_bytes()
    chunk.unlink()
    assert found(folder_of(sealed)) == [("sealed", "data.zarr/label/c.1")]
    chunk.write_bytes(data)  # other than a link, and equal
    assert found(folder_of(sealed)) == []
    chunk.write_bytes(data[:-1] + b"\0")
    assert found(folder_of(sealed)) == [("sealed", "data.zarr/label/c.1")]
    chunk.write_bytes(data)
    for extra in ("label/c.2", "label/c.01", "label/c.x", "other/c.0", "README"):
        path = store / extra
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
        assert found(folder_of(sealed)) == [("sealed", f"data.zarr/{extra}")]
        path.unlink()


def test_a_sealed_store_that_says_other_things_than_sealing_would(sealed: Run):
    path = folder_of(sealed) / "data.zarr/zarr.json"
    root = json.loads(path.read_text())
    for change in ({"n": 18}, {"n": 10**11}, {"missing_shards": [0]}, {"rows_sha256": "0" * 64}):
        path.chmod(0o644)
        path.write_text(json.dumps(root | {"attributes": root["attributes"] | change}))
        kinds = [f.kind for f in check(folder_of(sealed))[0] if f.is_damage]
        assert kinds and set(kinds) <= {"sealed"}, change
    path.write_text("[]")
    assert ("sealed", "data.zarr/zarr.json") in found(folder_of(sealed))


def test_a_sealed_root_with_an_empty_list_of_parts_is_found_and_sealed_again(merged: Path, sealed: Run):
    for folder in (folder_of(sealed), merged):
        path = folder / "data.zarr/zarr.json"
        whole = json.loads(path.read_text())
        path.chmod(0o644)
        path.write_text(json.dumps(whole | {"attributes": whole["attributes"] | {"parts": []}}))
        (finding,), checked = check(folder)
        assert (finding.kind, finding.key) == ("sealed", "data.zarr/zarr.json")
        assert finding.problem == "names rows that no plan wants" and not checked.is_sealed
        assert repair_runs(open_storage(folder)).left == []
        assert json.loads(path.read_text()) == whole and found(folder) == []


# Merged places -----------------------------------------------------------------------------------


@pytest.fixture
def merged(tmp_path: Path) -> Path:
    """A merged place of two sealed together."""
    place = tmp_path / "merged"
    specs = sorted((small_spec(seed) for seed in (1, 2)), key=lambda spec: spec.hash())
    for spec, n in zip(specs, (20, 13), strict=True):
        make_run(place / part_folder(spec.hash()), n, spec=spec)
    record = encode_record(Merged(parts=tuple(spec.hash() for spec in specs)))
    storage = open_storage(place)
    storage.put(MERGED, record)
    storage.put(f"copies/{MERGED}", record)
    seal(storage)
    return place


def test_a_merged_place_is_checked_part_by_part_and_as_one_store(merged: Path):
    findings, checked = check(merged)
    assert findings == []
    assert (checked.shards, checked.samples, checked.is_sealed) == (4, 40, True)
    part = sorted(p.name for p in (merged / "parts").iterdir())[1]
    (merged / "parts" / part / commit_key(0)).unlink()
    assert found(merged) == [("record", f"parts/{part}/{commit_key(0)}")]


def test_the_record_of_a_merged_place_comes_from_its_copy_or_its_parts(merged: Path):
    whole = (merged / MERGED).read_bytes()
    (merged / MERGED).unlink()
    (finding,), _ = check(merged)
    assert (finding.key, finding.cure) == (MERGED, Restore(whole))
    (merged / "copies" / MERGED).unlink()
    (finding,), _ = check(merged)
    assert (finding.key, finding.cure) == (MERGED, Restore(whole))


def test_a_part_that_is_gone(merged: Path):
    part = sorted(p for p in (merged / "parts").iterdir())[0]
    shutil.rmtree(part)
    findings, _ = check(merged)
    assert ("record", f"parts/{part.name}/manifest.json") in [(f.kind, f.key) for f in findings]
    assert not part.exists()


def test_nothing_is_written_by_a_check(merged: Path):
    before = {p: (p.lstat().st_mtime_ns, p.lstat().st_size) for p in merged.rglob("*")}
    (merged / MERGED).write_bytes(b"")
    before[merged / MERGED] = ((merged / MERGED).stat().st_mtime_ns, 0)
    check(merged)
    assert {p: (p.lstat().st_mtime_ns, p.lstat().st_size) for p in merged.rglob("*")} == before
