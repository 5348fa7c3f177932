"""The sealed store on S3: no rename, so its root alone decides whether there is one."""

from __future__ import annotations

import json

import numpy as np
import pytest
import zarr
from obstore.store import from_url
from zarr.storage import ObjectStore

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.sealing import SEALED, seal, sealed_root, unseal
from datagen.schemas.storage import Storage, open_storage
from tests.faults.crash_points_operations import small_schema
from tests.made_runs import attempt, manifest_of, rows_of, small_spec


@pytest.fixture
def place(bucket: str, monkeypatch: pytest.MonkeyPatch) -> Storage:
    """An empty prefix of a new bucket, for runs of few arrays."""
    monkeypatch.setitem(SCHEMAS, "heuristic", small_schema())
    return open_storage(f"{bucket}/some/run")


def make(place: Storage, n: int, shards: list[int] | None = None) -> Run:
    layout = Layout(scenes_per_shard=2, candidates_per_scene=5)
    run = Run.create_or_open(place, manifest_of(small_spec(), layout), n)
    for shard in run.missing() if shards is None else shards:
        assert attempt(run, shard, f"a-{shard}")
    return run


def opened(place: Storage) -> zarr.Group:
    """The store as any reader opens it that knows zarr alone."""
    store = ObjectStore(from_url(f"{place.url}/{SEALED}"), read_only=True)
    return zarr.open_group(store, mode="r")


def check(place: Storage, run: Run, shards: list[int], samples: int) -> None:
    tables = [rows_of(run, shard)[1] for shard in shards]
    group = opened(place)
    for name in ("sample_id", "label", "candidate_index"):
        rows = np.concatenate([table[name] for table in tables])[:samples]
        np.testing.assert_array_equal(group[name][:], rows, err_msg=name)


class Recorder:
    """Lets the n-th change of a storage fail, and keeps what was copied."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fail_at: int | None = None) -> None:
        self.changes, self.copied = 0, list[str]()
        self._fail_at = fail_at
        for name in ("put", "put_many", "delete", "adopt"):
            monkeypatch.setattr(Storage, name, self._around(name, getattr(Storage, name)))

    def _around(self, name, plain):
        def around(storage: Storage, *arguments):
            self.changes += 1
            if self.changes == self._fail_at:
                raise KeyboardInterrupt
            if name == "adopt":
                self.copied.append(arguments[2])
            return plain(storage, *arguments)

        return around


def test_it_holds_every_row_and_goes_away_again(place: Storage) -> None:
    run = make(place, 23)
    assert seal(place) == f"{place.url}/{SEALED}"
    check(place, run, [0, 1, 2], 23)
    root = sealed_root(place)
    assert root is not None
    assert (root.parts[0].n, root.parts[0].missing_shards) == (23, [])
    unseal(place)
    assert list(place.list(SEALED)) == []
    assert Run.open(place).committed() == {0, 1, 2}
    unseal(place)


def test_a_grown_run_copies_only_what_is_new(place: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    seal(make(place, 25).storage)
    run = make(place, 38)
    with monkeypatch.context() as patch:
        recorder = Recorder(patch)
        seal(place)
    copied = {key for key in recorder.copied if "/label/" in key}
    assert copied == {f"{SEALED}/label/c.3"}
    check(place, run, [0, 1, 2, 3], 38)


def test_rows_that_shift_are_copied_anew(place: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    run = make(place, 40, [1, 3])
    seal(place)
    check(place, run, [1, 3], 20)
    make(place, 40, [0])
    with monkeypatch.context() as patch:
        recorder = Recorder(patch)
        seal(place)
    assert {key for key in recorder.copied if "/label/" in key} == {f"{SEALED}/label/c.{i}" for i in range(3)}
    check(place, run, [0, 1, 3], 30)


def test_chunks_that_another_seal_takes_away_meanwhile_come_back(
    place: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, plain = make(place, 23), Storage.put
    taken: list[str] = []

    def other_removes_some(storage: Storage, key: str, data: bytes) -> None:
        if key == f"{SEALED}/zarr.json":
            taken.extend(f.key for f in place.list(SEALED) if "/c.1" in f.key)
            place.delete(taken)
            plain(place, f"{SEALED}/label/c.3", b"of a longer store")
        plain(storage, key, data)

    with monkeypatch.context() as patch:
        patch.setattr(Storage, "put", other_removes_some)
        seal(place)
    assert taken
    check(place, run, [0, 1, 2], 23)
    assert place.exists(f"{SEALED}/label/c.3")  # the longer store's root may stand by now


@pytest.mark.parametrize("grown", [True, False])
def test_ended_at_any_change_it_leaves_the_old_store_the_new_one_or_none(
    place: Storage, monkeypatch: pytest.MonkeyPatch, grown: bool
) -> None:
    shards = [0, 1] if grown else [1, 3]
    run = make(place, 40, shards)
    seal(place)
    make(place, 40, [2])
    now = sorted([*shards, 2])
    with monkeypatch.context() as patch:
        changes = Recorder(patch)
        seal(place)
    unseal(place)
    seen: set[str] = set()
    for fail_at in (*range(1, changes.changes + 1, 6), changes.changes + 1):
        place.delete([f"commits/{2:06d}.json"])
        unseal(place)
        seal(Run.open(place).storage)
        run_again = Run.open(place)
        commit = next(f.key for f in place.list("shards/000002") if f.key.endswith("commit.json"))
        kept = place.get(commit, 2**20)
        assert kept is not None
        place.put(f"commits/{2:06d}.json", kept)
        with monkeypatch.context() as patch:
            Recorder(patch, fail_at)
            try:
                seal(place)
            except KeyboardInterrupt:
                pass
        root = sealed_root(place)
        if root is None:
            seen.add("none")
            with pytest.raises((FileNotFoundError, zarr.errors.GroupNotFoundError)):
                opened(place)
        elif 2 in root.parts[0].missing_shards:
            seen.add("old")
            check(place, run_again, shards, 40)
        else:
            seen.add("new")
            check(place, run_again, now, 40)
        seal(place)
        check(place, run, now, 40)
    assert seen == ({"old", "new"} if grown else {"old", "none", "new"})


def test_what_lies_there_without_a_root_is_no_store_and_is_no_hindrance(place: Storage) -> None:
    run = make(place, 20)
    place.put(f"{SEALED}/label/c.0", b"garbage")
    place.put(f"{SEALED}/label/c.7", b"garbage")
    place.put(f"{SEALED}/nothing/of/ours", b"garbage")
    assert sealed_root(place) is None
    seal(place)
    check(place, run, [0, 1], 20)
    keys = {f.key for f in place.list(SEALED)}
    assert f"{SEALED}/label/c.7" not in keys and f"{SEALED}/nothing/of/ours" not in keys
    text = place.get(f"{SEALED}/zarr.json", 2**24)
    assert text is not None
    place.put(f"{SEALED}/zarr.json", json.dumps({**json.loads(text), "attributes": {}}).encode())
    assert sealed_root(place) is None


def test_a_missing_file_is_refused_before_anything_changes(place: Storage) -> None:
    make(place, 20)
    seal(place)
    before = {f.key: f.modified_s for f in place.list(SEALED)}
    place.delete(["shards/000001/a-1/label/c.0"])
    with pytest.raises(InputError, match=r"label/c\.0: is missing"):
        seal(place)
    assert {f.key: f.modified_s for f in place.list(SEALED)} == before
