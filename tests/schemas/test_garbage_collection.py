"""What is taken away again, by whom it was written, leaves what others have committed meanwhile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.keys import REMOVING, commit_copy_key, commit_key, shard_folder
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.record_files import encode_record
from datagen.schemas.run import Run
from datagen.schemas.storage import Storage
from tests.made_runs import attempt, check_digests, make_run, write

FULL = InputError("the disk", "", "No space left on device", "Free disk space")


@pytest.mark.parametrize("size", [1, 2])  # of the other run's shards: 1 lets both be cut, 2 links them
@pytest.mark.parametrize("is_first", [True, False])
def test_a_merge_without_room_leaves_what_another_one_has_committed(
    size: int, is_first: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two merges to one place give equal attempts: what one removes may be the other's by then."""
    make_run(tmp_path / "a", 10, 2)
    make_run(tmp_path / "b", 10, size, shards=[])
    planned = plan_merge([f"{tmp_path}/a", f"{tmp_path}/b"], f"{tmp_path}/out")
    plain, calls = Storage.sync, 0

    def full(storage: Storage, keys: Any) -> None:
        nonlocal calls
        some = list(keys)
        plain(storage, some)
        if any(key.startswith("shards/") and not key.endswith(REMOVING) for key in some):
            calls += 1
            if calls == 1:
                with monkeypatch.context() as patch:
                    patch.setattr(Storage, "sync", plain)
                    if not is_first:
                        merge_runs(planned)
                raise FULL

    with monkeypatch.context() as patch, pytest.raises(InputError, match="No space left"):
        patch.setattr(Storage, "sync", full)
        merge_runs(planned)
    out = Run.open(tmp_path / "out")
    assert calls == 1
    assert out.committed() == (set() if is_first else {0, 1} if size == 1 else {0})
    for commit in out.commits():
        check_digests(out, commit)
    left = [file.key for file in out.storage.list("shards")]
    assert not any(key.endswith(REMOVING) for key in left)
    assert bool(left) != is_first
    merge_runs(planned)
    assert list(Run.open(tmp_path / "out").missing()) == []


def test_a_commit_that_is_taken_back_leaves_no_copy_that_stands_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path, shards=[])
    commit, plain = write(run, 0, "slow"), Storage.put_new

    def and_gc_marks_it(storage: Storage, key: str, data: bytes) -> bool:
        won = plain(storage, key, data)
        storage.put(f"{shard_folder(0, 'slow')}/{REMOVING}", b"")
        return won

    with monkeypatch.context() as patch, pytest.raises(InputError, match="is being removed as garbage"):
        patch.setattr(Storage, "put_new", and_gc_marks_it)
        run.commit(commit)
    assert not run.storage.exists(commit_key(0))
    assert not run.storage.exists(commit_copy_key(0, "slow"))
    assert attempt(run, 0, "next")


def test_an_attempt_that_dies_in_its_commit_while_its_files_go_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path, shards=[])
    record, plain = encode_record(write(run, 0, "slow")), Storage.list

    def and_it_commits(storage: Storage, prefix: str) -> Any:
        storage.put_new(commit_key(0), record)
        return plain(storage, prefix)

    with monkeypatch.context() as patch:
        patch.setattr(Storage, "list", and_it_commits)
        assert run.remove_attempt(0, "slow") == "damaged"
    assert list(run.storage.list(shard_folder(0, "slow"))) == []


def test_who_loses_a_shard_leaves_no_copy_of_a_commit(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=20, shards=[0])
    assert not attempt(run, 0, "late")
    assert run.storage.exists(commit_copy_key(0, "a-0"))
    assert not run.storage.exists(commit_copy_key(0, "late"))


def test_an_attempt_is_removed_unless_its_shards_commit_may_name_it(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=20, shards=[0])
    write(run, 0, "late")
    before = {file.key for file in run.storage.list(shard_folder(0, "a-0"))}
    assert run.remove_attempt(0, "late") == "removed"
    assert not (tmp_path / shard_folder(0, "late")).exists()
    assert run.remove_attempt(0, "a-0") == "spared"
    (tmp_path / commit_key(0)).write_bytes(b"{}")
    assert run.remove_attempt(0, "a-0") == "spared"
    assert {file.key for file in run.storage.list(shard_folder(0, "a-0"))} == before


@pytest.mark.parametrize("written", [0, 1, 5])
def test_an_attempt_of_its_own_goes_from_a_full_disk_that_takes_no_mark(
    written: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, plain = make_run(tmp_path, shards=[]), Storage.put

    def full(storage: Storage, key: str, data: bytes) -> None:
        raise FULL

    def fills_up(storage: Storage, contents: Any) -> None:
        for key in list(contents)[:written]:
            plain(storage, key, contents[key])
        raise FULL

    with monkeypatch.context() as patch, pytest.raises(InputError, match="No space left"):
        patch.setattr(Storage, "put_many", fills_up)
        patch.setattr(Storage, "put", full)
        write(run, 0, "a")
    assert list(run.storage.list("shards")) == []
    assert run.committed() == set()
    attempt(run, 0, "b")
    assert run.committed() == {0}
