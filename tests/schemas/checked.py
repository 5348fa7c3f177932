"""What tests of stores share: schemas of few arrays, stored rows, findings of checks, and edited records."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from obstore.store import from_url
from zarr.storage import ObjectStore

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.merging import MergeResult, merge_runs, plan_merge
from datagen.schemas.record_files import signed_json
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, Cost, FileEntry, LedgerEntry
from datagen.schemas.sealing import seal, store_record
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.storage import Storage, open_storage
from tests.made_runs import Tables, attempt, make_run, rows_of, small_spec, write

Arrays = dict[str, np.ndarray[Any, Any]]

# Names, text, a vector and a cloud; both tables; all that checks compare with other records.
FEW = (
    *("scene_index", "redraws", "house_id", "points_m"),
    *("sample_id", "sample_scene_index", "candidate_index", "label", "distance_m"),
)
FULL = SCHEMAS["heuristic"]


def folder_of(run: Run) -> Path:
    assert run.storage.folder is not None
    return run.storage.folder


def sealed_run(folder: Path | str, n: int = 19) -> Run:
    """A sealed run of shards of two scenes, with one failed attempt."""
    run = make_run(folder, n)
    run.ledger.end(LedgerEntry(attempt="x-1", shard=1, outcome="crashed", cost=Cost(wall_s=2, cpu_s=1)))
    seal(run.storage)
    return run


def fill(
    folder: Path | str, who: str, shards: Iterable[int], n: int = 60, size: int = 2, seed: int = 0
) -> Run:
    """A run below a folder, with attempts of its own names."""
    run = make_run(f"{folder}/{who}", n, size, shards=[], spec=small_spec(seed))
    for shard in shards:
        assert attempt(run, shard, f"{shard:06d}-{who}-{size}")
    return run


def merge(folder: Path | str, names: Iterable[str], out: str = "out") -> MergeResult:
    return merge_runs(plan_merge([f"{folder}/{name}" for name in names], f"{folder}/{out}"))


def commit_object(run: Run, shard: int, data: bytes, name: str = "f") -> Commit:
    """Commit any bytes as a shard's object, with the sums of the rows that the shard should have."""
    commit = write(run, shard, name)
    run.storage.put(f"shards/{name}.zip", data)
    run.ledger.start(name, shard)
    commit = commit.model_copy(update={"object": FileEntry.of(f"{name}.zip", data)})
    assert run.commit(commit)
    return commit


def encoded(run: Run, tables: Tables) -> bytes:
    return encode_shard(run.schema, run.layout, run.manifest.spec_hash, *tables)


def edit(path: Path, **changes: Any) -> None:
    """Change a record and sign it again, as a program that knows the format would."""
    record = json.loads(path.read_text())
    del record["sha256"]
    path.write_bytes(signed_json(record | changes))


def of(run: Run, *shards: int) -> list[tuple[Run, int]]:
    return [(run, shard) for shard in shards]


def expected(shards: Iterable[tuple[Run, int]], scenes: int | None = None, n: int | None = None) -> Arrays:
    """The rows that shards were given, one after the other, cut to these numbers of scenes and samples."""
    tables = [rows_of(run, shard) for run, shard in shards]
    return {
        name: np.concatenate([each[t][name] for each in tables])[:rows]
        for t, rows in ((0, scenes), (1, n))
        for name in tables[0][t]
    }


def stored(storage: Storage) -> Arrays:
    """Every array of the sealed store that counts, read by zarr alone; each of its files is as recorded."""
    record = store_record(storage)
    assert record is not None
    for entry in record.files:
        data = storage.get(f"{record.name}/{entry.path}", entry.size)
        assert data is not None and sha256(data).hexdigest() == entry.sha256, entry.path
    assert len(list(storage.list(record.name))) == len(record.files)
    path = f"{storage.url}/{record.name}"
    store = path if storage.folder else ObjectStore(from_url(path), read_only=True)
    return {name: np.asarray(array[:]) for name, array in zarr.open_group(store, mode="r").arrays()}


def assert_rows(found: Arrays, wanted: Arrays) -> None:
    assert found.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def tree(storage: Storage) -> dict[str, bytes | None]:
    """Every file of a storage."""
    return {file.key: storage.get(file.key, 2**30) for file in storage.list("")}


def check(place: Path | str) -> tuple[list[Finding], Checked]:
    checked = Checked()
    return list(check_runs(open_storage(place, probe=False, create=False), checked)), checked


def found(place: Path | str) -> list[tuple[str, str]]:
    """(kind, file) of every finding."""
    return [(f.kind, f.key) for f in check(place)[0]]


class Killed(BaseException):
    """The end of a process: none of its later changes is made either."""


class Changes:
    """Counts the changes of storages while it is open; `before` is called before each."""

    def __init__(self, before: Callable[[int], None]) -> None:
        self.made, self._before, self._patch = 0, before, pytest.MonkeyPatch()

    def __enter__(self) -> Changes:
        for name in ("put", "put_new", "delete", "remove_empty"):
            self._patch.setattr(Storage, name, self._counted(getattr(Storage, name)))
        return self

    def __exit__(self, *_: object) -> bool:
        self._patch.undo()
        return isinstance(_[1], Killed)

    def _counted(self, plain: Callable[..., Any]) -> Callable[..., Any]:
        def change(*arguments: Any, **options: Any) -> Any:
            self.made += 1
            self._before(self.made)
            return plain(*arguments, **options)

        return change


def dies_at(number: int) -> Callable[[int], None]:
    def die(made: int) -> None:
        if made >= number:
            raise Killed

    return die
