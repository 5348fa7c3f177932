"""Seal runs: one flat Zarr v3 store over the committed shards, which any Zarr reader opens.

The store is written once, shard by shard, with the shards' own chunks in a few large files (Zarr's sharding
codec). It has a new name, and counts from the moment that `data.json` names it; then the one before it is
removed.
"""

from __future__ import annotations

import re
import secrets
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from itertools import chain, count, takewhile

import numpy as np
import zarr
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from datagen.schemas.errors import InputError
from datagen.schemas.fields import TABLES, Field, RecordSchema, Table
from datagen.schemas.record_files import encode_record, read_record
from datagen.schemas.run import Rows, Run, open_runs
from datagen.schemas.run_records import Commit, FileEntry, Layout, SealedPart, StoreRecord
from datagen.schemas.shard_files import (
    cf_attributes,
    described,
    encode_chunk,
    fill_value,
    root_attributes,
    with_crc32c,
    zarr_metadata,
)
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.shard_reading import committed_place
from datagen.schemas.storage import Storage
from datagen.schemas.stored_arrays import Array, StoredArray, arrays_of, parse_metadata

SEALED = "data.zarr"
RECORD = "data.json"


def store_record(storage: Storage) -> StoreRecord | None:
    """The record of the sealed store; None where there is none. InputError for a damaged one."""
    return read_record(storage, RECORD, StoreRecord)


@dataclass(frozen=True, eq=False)
class SealedRun:
    """The shards of one run that a store holds, of those that its first n samples need."""

    run: Run
    n: int
    commits: tuple[Commit, ...]
    is_last: bool  # the last run that has shards

    def rows_of(self, commit: Commit) -> Rows:
        """The rows of a shard in the store: whole scenes, but the store's last shard is cut to n."""
        rows = self.run.rows_of(commit.shard, self.n)
        if self.is_last and commit is self.commits[-1]:
            return rows
        return rows._replace(samples=rows.scenes * self.run.layout.candidates_per_scene)

    def part(self) -> SealedPart:
        done = ShardRanges.of(commit.shard for commit in self.commits)
        return SealedPart(
            spec_hash=self.run.manifest.spec_hash,
            scenes_per_shard=self.run.layout.scenes_per_shard,
            n=self.n,
            samples=sum(self.rows_of(commit).samples for commit in self.commits),
            missing=self.run.planned(self.n).without(done).ranges,
        )


@dataclass(frozen=True, eq=False)
class Contents:
    """What a store over runs holds now. `layout` is that of its largest shards, whose chunks it has."""

    runs: tuple[SealedRun, ...]
    schema: RecordSchema
    layout: Layout

    @property
    def shards(self) -> Iterator[tuple[SealedRun, Commit, Rows]]:
        return ((run, commit, run.rows_of(commit)) for run in self.runs for commit in run.commits)

    def rows(self, table: Table) -> int:
        return sum(rows.scenes if table == "scene" else rows.samples for _, _, rows in self.shards)

    def parts(self) -> tuple[SealedPart, ...]:
        return tuple(run.part() for run in self.runs)

    def digest(self) -> str:
        """Digest of the rows: over specification, shard, rows and object of each, in order."""
        digest = sha256()
        for sealed, commit, rows in self.shards:
            spec_hash = sealed.run.manifest.spec_hash
            digest.update(f"{spec_hash} {commit.shard} {tuple(rows)} {commit.object.sha256}\n".encode())
        return digest.hexdigest()


def read_contents(runs: Sequence[Run]) -> Contents:
    """The committed planned shards of runs in order, run after run.

    InputError when no shard is committed, for a damaged commit, or when the runs have different arrays.
    """
    first = runs[0]
    for run in runs:
        one, other = ((r.schema, r.layout.candidates_per_scene) for r in (first, run))
        if one != other:
            problem = f"has other arrays than {first.storage.url}: one store cannot hold both"
            raise InputError(run.storage.url, "manifest.json", problem, "Read them as separate runs")
    held: list[tuple[Run, int, tuple[Commit, ...]]] = []
    for run in runs:
        planned = run.planned(n := run.n)
        held.append((run, n, tuple(c for c in run.brief_commits() if c.shard in planned)))
    last = max((k for k, (_, _, commits) in enumerate(held) if commits), default=None)
    if last is None:
        place = first.storage.url
        raise InputError(place, "commits", "no shard is committed", "Make some with `datagen resume`")
    sealed = tuple(SealedRun(run, n, commits, k == last) for k, (run, n, commits) in enumerate(held))
    layout = max((run.layout for run in runs), key=lambda layout: layout.scenes_per_shard)
    return Contents(sealed, first.schema, layout)


_ROOT = "zarr.json"
_NUMBERED = re.compile(r"data(?:-([0-9]+))?\.zarr")
CLAIM = ".claim"  # beside a store: who made it first writes the store
_NO_CHUNK = 2**64 - 1  # offset and size of a chunk beyond the array's end
Tick = Callable[[int, int], None]


def seal(storage: Storage, tick: Tick = lambda done, total: None, runs: Sequence[Run] | None = None) -> str:
    """Write the store over the committed shards of the run, or merged runs, in `storage`; return its address.

    `runs` are those of `open_runs`, where they are open.

    Quarantined and missing shards are omitted. Nothing is written where the store is up to date. `tick` is
    called with the number of shards written, and of all. InputError when no shard is committed, a shard is
    missing or damaged, merged runs have different arrays, or the disk or the server fails.
    """
    contents = read_contents(runs or open_runs(storage))
    old = store_record(storage)
    rows = contents.digest(), contents.parts()
    if old is not None and (old.rows_sha256, old.parts) == rows:
        return f"{storage.url}/{old.name}"
    name = _claimed_name(storage, old)
    try:
        files = tuple(_write(storage, name, contents, tick))
        other = store_record(storage)
        if other is not None and (other.rows_sha256, other.parts) == rows:
            remove_store(storage, name)  # another driver that ended at the same time was faster
            return f"{storage.url}/{other.name}"
        new = StoreRecord(name=name, rows_sha256=rows[0], parts=rows[1], files=files)
        storage.put(RECORD, encode_record(new))
    except BaseException:
        with suppress(InputError):
            named = store_record(storage)  # written even where an error was reported, as of its folder
            if named is None or named.name != name:
                remove_store(storage, name)
                storage.delete([f"{name}{CLAIM}"])  # no record named it, so no other process removes it
        raise
    if old is not None:
        remove_store(storage, old.name)
    return f"{storage.url}/{name}"


def remove_store(storage: Storage, name: str) -> None:
    """Remove a store, its root first, so that it is never readable in part.

    Its claim stays: a name that is used once cannot be written while another process removes its files.
    """
    storage.delete([f"{name}/{_ROOT}"])
    storage.delete([file.key for file in storage.list(name)])
    storage.remove_empty(name)


def claimed_names(storage: Storage) -> list[str]:
    """The names of all stores that were begun, in order."""
    return list(takewhile(lambda name: storage.exists(f"{name}{CLAIM}"), map(_store_name, count(1))))


def _store_name(number: int) -> str:
    return SEALED if number == 1 else f"data-{number}.zarr"


def _claimed_name(storage: Storage, old: StoreRecord | None) -> str:
    """`data.zarr`, or where a store of that name was begun before, the next of `data-2.zarr`, ..."""
    before = _NUMBERED.fullmatch(old.name) if old else None
    first = int(before[1] or 1) + 1 if before else 1
    claim = secrets.token_bytes(8)  # its own bytes, so that another process's claim is not taken for it
    names = map(_store_name, count(first))
    return next(name for name in names if storage.put_new(f"{name}{CLAIM}", claim))


def _write(storage: Storage, name: str, contents: Contents, tick: Tick) -> Iterator[FileEntry]:
    """Write every file of the store durably, its root last; yield their entries."""
    metadata = sealed_metadata(contents)
    arrays = {
        field.name: ArrayFiles(parse_metadata(name, field.name, metadata[f"{field.name}/{_ROOT}"]), field)
        for _, field in contents.schema.fields
    }

    def put(path: str, data: bytes) -> FileEntry:
        storage.put(f"{name}/{path}", data)
        return FileEntry.of(path, data)

    shards = list(contents.shards)
    for done, (sealed, commit, rows) in enumerate(shards, 1):
        layout = sealed.run.layout
        stored = arrays_of(contents.schema, layout)
        place = committed_place(sealed.run, commit, rows)
        is_whole = rows[:2] == (0, layout.scenes_per_shard) or (done == len(shards) and not rows.first)
        aligned = all(files.is_aligned for files in arrays.values())
        if layout == contents.layout and is_whole and aligned:
            found = (arrays[array.name].add_chunk(chunk) for array, _, chunk in place.chunks(stored.values()))
        else:
            values = place.read(stored.values())
            found = (arrays[array].add_rows(values[array]) for array in arrays)
        for path, data in chain.from_iterable(found):
            yield put(path, data)
        tick(done, len(shards))
    for files in arrays.values():
        for path, data in files.close():
            yield put(path, data)
    for path in sorted(metadata, key=lambda path: path == _ROOT):
        yield put(path, metadata[path])


def sealed_metadata(contents: Contents) -> dict[str, bytes]:
    """zarr.json files of the store by path; the root's has consolidated metadata."""
    first = contents.runs[0].run.manifest
    attributes = root_attributes(contents.schema, contents.layout, first.spec_hash)
    parts = [
        {**part.model_dump(mode="json"), "specification": sealed.run.manifest.spec.document()}
        for sealed, part in zip(contents.runs, contents.parts(), strict=True)
    ]
    if len(parts) > 1:
        del attributes["spec_hash"]
    attributes |= {"parts": parts, "rows_sha256": contents.digest()}
    manifests = [sealed.run.manifest for sealed in contents.runs]
    specs, sources = [m.spec for m in manifests], [m.sources for m in manifests]
    attributes = described(specs, sources, [sealed.n for sealed in contents.runs]) | attributes
    rows = {table: contents.rows(table) for table in TABLES}
    of_arrays = {f.name: cf_attributes(f, table) for table, f in contents.schema.fields}
    return consolidated(
        zarr_metadata(contents.schema, contents.layout, rows, attributes, of_arrays, is_sharded=True)
    )


def consolidated(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """zarr.json files by path, the root's with those of all arrays."""
    make = default_buffer_prototype().buffer.from_bytes
    store = {path: make(data) for path, data in files.items()}
    with warnings.catch_warnings():
        # Consolidated metadata is not in the Zarr v3 specification yet; common readers support it.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(MemoryStore(store), zarr_format=3)
    return {path: buffer.to_bytes() for path, buffer in store.items()}


class ArrayFiles:
    """Collects an array's chunks and yields (path, bytes) of each full file. Holds at most one file."""

    def __init__(self, array: StoredArray, field: Field) -> None:
        self._array, self._field = array, field
        self._chunks: list[bytes] = []
        self._pending: list[Array] = []  # rows that do not fill a chunk yet
        self._files = 0

    @property
    def is_aligned(self) -> bool:
        """Whether the next row begins a chunk."""
        return not self._pending

    def add_chunk(self, chunk: bytes) -> Iterator[tuple[str, bytes]]:
        """Add an encoded chunk, at the beginning of a chunk."""
        self._chunks.append(chunk)
        if len(self._chunks) == self._array.per_file:
            yield self._file()

    def add_rows(self, values: Array) -> Iterator[tuple[str, bytes]]:
        """Add rows, which are encoded as soon as they fill a chunk."""
        rows = np.concatenate([*self._pending, values])
        size = self._array.chunk_rows
        for first in range(0, len(rows) - size + 1, size):
            yield from self.add_chunk(encode_chunk(self._field, rows[first : first + size]))
        rest = rows[len(rows) // size * size :]
        self._pending = [rest.copy()] if len(rest) else []

    def close(self) -> Iterator[tuple[str, bytes]]:
        if self._pending:
            missing = self._array.chunk_rows - len(self._pending[0])
            shape = (missing, *self._array.shape[1:])
            filler = np.full(shape, fill_value(self._field), self._pending[0].dtype)
            yield from self.add_rows(filler)
        if self._chunks:
            yield self._file()

    def _file(self) -> tuple[str, bytes]:
        index = np.full((self._array.per_file, 2), _NO_CHUNK, "<u8")
        sizes = np.array([len(chunk) for chunk in self._chunks], np.uint64)
        index[: len(sizes), 0] = np.cumsum(sizes) - sizes
        index[: len(sizes), 1] = sizes
        data = b"".join([*self._chunks, with_crc32c(index.tobytes())])
        path = self._array.path(self._files)
        self._chunks, self._files = [], self._files + 1
        return path, data


ZIPPED = ".zarr.zip"  # a store of some scenes of a run, as `scripts/pack_benchmark.py` writes it
