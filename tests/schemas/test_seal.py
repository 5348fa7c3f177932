"""The sealed store: what stock libraries read is what was committed, and only whole stores count."""

from __future__ import annotations

import errno
import json
import subprocess
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import tensorstore
import xarray
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas import shard_files, stored_arrays
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.sealing import seal, store_record
from datagen.schemas.shard_reading import ZipFiles
from datagen.schemas.specification import Source
from datagen.schemas.storage import Storage, open_storage, storage_error
from datagen.train.run_parts import open_parts
from tests.made_runs import attempt, files_of, make_run, manifest_of, small_spec, write
from tests.schemas.checked import (
    FULL,
    Changes,
    assert_rows,
    dies_at,
    edit,
    expected,
    folder_of,
    found,
    of,
    stored,
)  # fmt: skip
from tests.small_disk import small_disk

pytestmark = pytest.mark.usefixtures("few_arrays")

# What a store holds ---------------------------------------------------------------------------


def in_tensorstore(path: str) -> np.ndarray:
    """An array of a store, read by tensorstore."""
    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{path}/"}}
    return np.asarray(tensorstore.open(spec, read=True).result().read().result())


def test_zarr_and_xarray_read_rows_in_order_with_dimensions_units_and_licences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCHEMAS, "heuristic", FULL)
    houses, objects = Source(kind="procthor", digest="1" * 64), Source(kind="ycb", digest="2" * 64)
    spec = small_spec().model_copy(update={"houses": houses, "objects": objects})
    stated = {"houses_title": "My houses", "houses_licence": "CC0-1.0", "houses_attribution": "me"}
    run = make_run(tmp_path, n=43, shards=[4, 0, 2, 1, 3], spec=spec, sources=stated)
    assert seal(run.storage) == f"{tmp_path}/data.zarr"
    wanted = expected(of(run, 0, 1, 2, 3, 4), 9, 43)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_rows(stored(run.storage), wanted)
        data = xarray.open_zarr(f"{tmp_path}/data.zarr", chunks=None).load()
    assert_rows({str(name): data[name].values for name in data.variables}, wanted)
    for table, f in run.schema.fields:
        if f.is_text:  # as docs/guides/read-data.md says
            with pytest.raises(ValueError, match="data_type"):
                in_tensorstore(f"{tmp_path}/data.zarr/{f.name}")
        else:
            np.testing.assert_array_equal(in_tensorstore(f"{tmp_path}/data.zarr/{f.name}"), wanted[f.name])
        assert data[f.name].dims == (table, *f.dims)
        assert (data[f.name].attrs.get("units", ""), data[f.name].attrs["long_name"]) == (f.unit, f.doc)
    keys = ["scene_index", "house_id", "sample_scene_index", "candidate_index", "robot_index"]
    assert set(data.coords) == set(keys) and data["label"].encoding["coordinates"] == " ".join(keys[2:])
    told, (part,) = data.attrs, data.attrs["parts"]
    assert told["spec_hash"] == part["spec_hash"] == spec.hash() and part["specification"] == spec.document()
    assert (part["n"], part["samples"], part["missing"]) == (43, 43, [])
    assert told["Conventions"] == "CF-1.11, ACDD-1.3" and "datagen.candidates" in told["comment"]
    assert told["title"] == "Robot base poses labelled by heuristic, in My houses with objects read as ycb"
    assert told["license"] == "My houses: CC0-1.0; objects read as ycb: not stated"
    assert told["references"] == "me" and told["acknowledgement"].startswith("My houses: me; ")
    assert f"objects ycb sha256 {'2' * 64}" in told["source"] and spec.hash() in told["history"]
    assert told["history"].startswith("datagen submit heuristic --n 43, seed 0")


def clear_metadata() -> None:
    for made_once in (shard_files.group_metadata, shard_files._made_by_zarr, stored_arrays.arrays_of):  # pyright: ignore[reportPrivateUsage]
        made_once.cache_clear()


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Real clouds would take gigabytes."""
    for name, size in (("MAX_CHUNK_BYTES", 1000), ("_FILE_BYTES", 2000), ("_CLOUD_FILE_BYTES", 2000)):
        monkeypatch.setattr(shard_files, name, size)
    clear_metadata()
    yield
    clear_metadata()


@pytest.mark.usefixtures("small_chunks")
def test_chunks_of_shards_lie_unchanged_in_files_of_several(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=75, scenes_per_shard=6)
    seal(run.storage)
    wanted = expected(of(run, 0, 1, 2), 15, 75)
    assert_rows(stored(run.storage), wanted)
    files = files_of(tmp_path / "data.zarr")
    assert [f"points_m/c.{k}.0.0" in files for k in range(5)] == [True] * 4 + [False]
    objects = [ZipFiles("", run.read_object(commit)) for commit in run.commits()]
    chunks = [zipped.get(f"points_m/c.{k}.0.0") for zipped in objects for k in range(3)]
    assert all(chunk in files[f"points_m/c.{k // 2}.0.0"] for k, chunk in enumerate(chunks[:8]))
    (part,) = open_parts([tmp_path / "data.zarr"], ["points_m", "label"])
    values = [place.read(part.arrays.values()) for place in part.shards]
    for name in ("points_m", "label"):
        np.testing.assert_array_equal(np.concatenate([each[name] for each in values]), wanted[name])


def test_missing_shards_are_left_out_and_named_also_of_a_trillion(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=48, shards=[1, 4])
    seal(run.storage)
    assert_rows(stored(run.storage), expected(of(run, 1, 4), 4, 18))
    run.grow(10**12)
    seal(run.storage)
    record = store_record(run.storage)
    assert record is not None and record.parts[0].samples == 20
    assert record.parts[0].missing == ((0, 1), (2, 4), (5, 10**11))


def test_nothing_committed_damaged_shards_and_links_are_refused_and_leave_the_old_store(
    tmp_path: Path,
) -> None:
    with pytest.raises(InputError, match="no shard is committed"):
        seal(make_run(tmp_path / "empty", shards=[]).storage)
    for kind in ("file", "link"):
        run, path = make_run(tmp_path / kind, n=20), tmp_path / kind / "data.zarr"
        path.write_text("no store") if kind == "file" else path.symlink_to(tmp_path / "empty")
        with pytest.raises(InputError, match=r"a folder is needed|which a run never has"):
            seal(run.storage)
    assert not (tmp_path / "empty/label").exists()
    run = make_run(tmp_path / "run", n=20)
    seal(run.storage)
    make_run(tmp_path / "run", n=30)
    (tmp_path / "run/shards/a-2.zip").write_bytes(b"x")
    before = files_of(tmp_path / "run")
    with pytest.raises(InputError, match=r"a-2\.zip: has \d+ bytes with another"):
        seal(run.storage)
    assert files_of(tmp_path / "run") == before


# When a store is written ----------------------------------------------------------------------


def test_an_up_to_date_store_is_not_written_and_a_grown_run_switches_to_another(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=13)
    seal(run.storage)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert seal(run.storage) == f"{tmp_path}/data.zarr"
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    for number, n in ((2, 14), (3, 37)):  # within the last shard, and by new ones
        make_run(tmp_path, n=n)
        assert seal(run.storage) == f"{tmp_path}/data-{number}.zarr"
        assert_rows(stored(run.storage), expected(of(run, *run.planned()), -(-n // 5), n))
        assert [path.name for path in tmp_path.glob("*.zarr")] == [f"data-{number}.zarr"]
    assert found(tmp_path) == []
    run.storage.delete(["data.json"])
    assert seal(run.storage) == f"{tmp_path}/data-4.zarr"  # another process may still remove those before


def test_a_disk_that_fills_up_keeps_what_is_committed_and_continues_with_room(tmp_path: Path) -> None:
    with small_disk(tmp_path / "tiny", "512k") as disk:
        run = make_run(disk, n=1, shards=[])
        run.grow(3000)
        with pytest.raises(InputError, match=r"No space left on device\. Free disk space"):
            for shard in run.missing():
                assert run.commit(write(run, shard, f"a-{shard}"))
        done = sorted(run.committed())
        assert done and all(run.read_object(commit) for commit in Run.open(disk).commits())
        with pytest.raises(InputError, match="No space left on device"):
            seal(run.storage)
        assert list(disk.glob("data*")) == []
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        assert run.commit(write(run, len(done), "b"))
        assert seal(run.storage) == f"{disk}/data.zarr"
        assert_rows(stored(run.storage), expected(of(run, *done, len(done))))


@pytest.mark.parametrize("place", ["disk", "s3"])
def test_a_killed_seal_leaves_the_old_store_or_the_new_one(place: str, tmp_path: Path, bucket: str) -> None:
    storage = open_storage(tmp_path / "run" if place == "disk" else f"{bucket}/some/run")
    layout = Layout(scenes_per_shard=2, candidates_per_scene=5)
    run = Run.create_or_open(storage, manifest_of(small_spec(), layout), 10)
    seen, shards, at, was_killed = set[str](), 0, 1, True
    while was_killed:
        assert attempt(run, shards, f"a-{shards}")
        old, shards = store_record(storage), shards + 1
        with Changes(dies_at(at)) as changes:
            seal(storage)
        record = store_record(storage)
        seen.add("none" if record is None else "old" if record == old else "new")
        if record is not None:
            assert_rows(stored(storage), expected(of(run, *range(record.parts[0].n // 10))))
        assert {kind for kind, _ in found(storage.url)} <= {"stale", "sealed"}
        was_killed, at = changes.made >= at, at + (1 if place == "disk" and at < 4 else 9)
        seal(storage)
        assert_rows(stored(storage), expected(of(run, *range(shards))))
        assert found(storage.url) == []
        run.grow(run.n + 10)
    assert seen == {"none", "old", "new"}


class Turns:
    """Lets one of several threads at a time make its next change, in a given order."""

    def __init__(self, order: list[int], count: int) -> None:
        self._order, self._waiting, self._running = list(order), dict[int, threading.Event](), count
        self._lock = threading.Lock()

    def wait(self) -> None:
        with self._lock:
            event = self._waiting[threading.get_ident()] = threading.Event()
            self.next()
        event.wait()

    def next(self, ended: int = 0) -> None:
        self._running -= ended
        if self._running and len(self._waiting) == self._running:
            number = self._order.pop() if self._order else 0
            self._waiting.pop(sorted(self._waiting)[number % len(self._waiting)]).set()

    def end(self) -> None:
        with self._lock:
            self.next(ended=1)


@settings(max_examples=12)
@given(order=st.lists(st.integers(0, 5), min_size=200, max_size=200))
def test_seals_at_the_same_time_leave_a_whole_store_in_any_order(
    order: list[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Processes that seal the run again and again while it grows, each change in turn."""
    run, turns = make_run(tmp_path_factory.mktemp("run"), 10), Turns(order, 3)

    def act(me: int) -> None:
        try:
            for k in range(3):
                run.grow(10 + 10 * k + 5 * me)
                for shard in run.missing():
                    attempt(run, shard, f"{me}-{k}-{shard}")
                seal(Run.open(folder_of(run)).storage)
        finally:
            turns.end()

    with Changes(lambda made: turns.wait()), ThreadPoolExecutor(3) as pool:
        list(pool.map(act, range(3)))
    stored(run.storage)  # whole
    assert {kind for kind, _ in found(folder_of(run))} <= {"stale", "account"}
    seal(run.storage)
    assert_rows(stored(run.storage), expected(of(run, *run.planned())))


@pytest.mark.parametrize("is_written", [False, True])
def test_a_seal_whose_record_fails_leaves_a_store_only_if_it_is_named(
    is_written: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, put = make_run(tmp_path, 10), Storage.put
    seal(run.storage)
    make_run(tmp_path, 20)

    def full(self: Storage, key: str, data: bytes, durably: bool = True) -> None:
        if key != "data.json" or is_written:
            put(self, key, data, durably)
        if key == "data.json":
            raise storage_error(tmp_path / key, OSError(errno.EDQUOT, ""))

    with monkeypatch.context() as patched, pytest.raises(InputError, match="Disk quota exceeded"):
        patched.setattr(Storage, "put", full)
        seal(run.storage)
    record = store_record(run.storage)
    assert record is not None and record.name == ("data-2.zarr" if is_written else "data.zarr")
    assert_rows(stored(run.storage), expected(of(run, *range(1 + is_written))))
    assert is_written or [path.name for path in tmp_path.glob("data*.zarr*")] == [
        "data.zarr",
        "data.zarr.claim",
    ]


def test_of_two_seals_of_the_same_rows_one_store_stays(tmp_path: Path) -> None:
    """Two drivers end at once: the second is done while the first writes."""
    run, others = make_run(tmp_path, 30), list[str]()

    def tick(done: int, total: int) -> None:
        if not others:
            others.append(seal(Run.open(tmp_path).storage))

    assert [seal(run.storage, tick)] == others
    assert [f"{path}" for path in tmp_path.glob("*.zarr")] == others and found(tmp_path) == []
    assert_rows(stored(run.storage), expected(of(run, *run.planned())))


# Stores from elsewhere ------------------------------------------------------------------------


def with_index(data: bytes, *entry: int) -> bytes:
    """A file of four chunks whose index says something else of the first, with the right checksum."""
    return data[:-68] + shard_files.with_crc32c(np.array(entry, "<u8").tobytes() + data[-52:-4])


def test_truncated_files_and_hostile_indices_are_damage_on_disk_and_on_s3(
    tmp_path: Path, bucket: str
) -> None:
    for place in (str(tmp_path / "run"), f"{bucket}/run"):
        storage = make_run(place, 40).storage
        seal(storage)
        key = "data.zarr/points_m/c.0.0.0"
        whole = storage.get(key, 2**20)
        assert whole is not None
        cuts = (whole[:-1], whole[:3], whole[len(whole) // 2 :], b"\0" * len(whole))
        odd = ((0, 0), (2**64 - 1, 2**64 - 1), (0, 2**30), (2**40, 9), (2**63, 5), (3, 2**31), (7, 99))
        for data in (*cuts, *(with_index(whole, *entry) for entry in odd)):
            storage.put(key, data)
            (part,) = open_parts([f"{place}/data.zarr"], ["points_m", "label"])
            with pytest.raises(InputError, match=r"points_m/c\.0\.0\.0: points_m: ") as e:
                part.shards[0].read(part.arrays.values())
            assert type(e.value) is InputError  # not an unavailable store
            assert found(place) == [("sealed", key)]


HOSTILE: dict[str, list[object]] = {
    "shape": [[10**30, 64, 3], [-1, 64, 3], [], "x", None],
    "data_type": ["O", "float65", "(3,2", None, {"name": "x"}, "string"],
    "chunk_grid": [{}, *({"configuration": {"chunk_shape": [rows, 64, 3]}} for rows in (0, 2**40))],
    "codecs": [[], [{}], None, [{"name": "bytes"}], [{"name": "sharding_indexed", "configuration": {}}]],
    "dimension_names": [["scene"], None, ["x", "y", "z"], "scene"],
    "attributes": [5, "ab"],
    "zarr_format": [2, None],
}


def test_hostile_metadata_and_records_of_a_store_are_refused_in_one_line(tmp_path: Path) -> None:
    storage = make_run(tmp_path, 40).storage
    seal(storage)
    path, record = tmp_path / "data.zarr/points_m/zarr.json", tmp_path / "data.json"
    whole, kept = json.loads(path.read_text()), record.read_bytes()
    for field, value in ((field, value) for field, values in HOSTILE.items() for value in values):
        path.write_text(json.dumps(whole | {field: value}))
        with pytest.raises(InputError, match=r"data\.zarr/(points_m/)?zarr\.json: "):
            open_parts([tmp_path / "data.zarr"], ["points_m", "label"])
    path.write_text(json.dumps(whole, indent=2))
    outside = {"path": "../x", "size": 1, "sha256": "0" * 64}
    odd = {"name": ["../other.zarr", "data-0.zarr"], "files": [[outside]], "parts": [[]], "surprise": [1]}
    for field, value in ((field, value) for field, values in odd.items() for value in values):
        edit(record, **{field: value})
        with pytest.raises(InputError, match=rf"data\.json: {field}"):
            seal(storage)
        assert found(tmp_path) == [("sealed", "data.json")]
        record.write_bytes(kept)
