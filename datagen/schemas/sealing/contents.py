"""The content of a sealed store: shards in order, their files, and the zarr.json files over them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import chain
from typing import Any

import zarr
from pydantic import BaseModel, ValidationError
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from datagen.schemas.errors import InputError
from datagen.schemas.fields import TABLES, Field, RecordSchema, Table
from datagen.schemas.record_files import MAX_RECORD_BYTES, REPAIR, part_folder, shard_folder
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import Commit, Layout, ShardRanges
from datagen.schemas.shard_files import (
    cf_attributes,
    chunk_key,
    chunk_paths,
    described,
    group_metadata,
    root_attributes,
    rows_per_shard,
    zarr_metadata,
)
from datagen.schemas.storage import Storage

# Far above any real run.
MOST_SHARDS = 10_000_000
# The root's metadata lists missing shards one by one, and has the size limit of a record.
_MOST_MISSING = 500_000


@dataclass(frozen=True)
class SealedShard:
    """One committed shard and its rows in the store."""

    folder: str  # where its files lie, relative to the sealed path
    scenes: int
    samples: int


@dataclass(frozen=True, eq=False)
class SealedRun:
    """The shards of one run in the store. `n` is read once: the run may grow meanwhile."""

    run: Run
    n: int
    shards: ShardRanges
    missing_shards: ShardRanges
    first: int  # position of its first shard in the store
    is_last: bool = False  # its last shard is the store's, and cut to n

    def position_of(self, shard: int) -> int:
        return self.first + self.shards.position_of(shard)

    def rows_of(self, shard: int) -> tuple[int, int]:
        """(scenes, samples) of a shard in the store."""
        layout = self.run.layout
        if self.is_last and shard == self.shards[-1]:
            return layout.rows_wanted(shard, self.n)
        return layout.scenes_per_shard, layout.samples_per_shard


class RowsDigest:
    """Digest of a store's rows: over its shards and their files, in order."""

    def __init__(self) -> None:
        self._digest = sha256()

    def add(self, spec_hash: str, commit: Commit) -> None:
        """Add the shard of a commit, by a run of this specification."""
        self._digest.update(f"{spec_hash} {commit.shard}\n".encode())
        for entry in sorted(commit.files, key=lambda e: e.path):
            self._digest.update(f"{entry.path} {entry.sha256}\n".encode())

    def hexdigest(self) -> str:
        return self._digest.hexdigest()


@dataclass(frozen=True)
class Contents:
    """The rows of a store. `digests[k]` is over the bytes of the files of its first k shards."""

    storage: Storage
    runs: tuple[SealedRun, ...]
    shards: tuple[SealedShard, ...]
    digests: tuple[str, ...]
    schema: RecordSchema
    layout: Layout

    @property
    def is_merged(self) -> bool:
        return len(self.runs) > 1

    def rows(self, table: Table) -> int:
        return sum(shard.scenes if table == "scene" else shard.samples for shard in self.shards)

    def chunks(self, field: Field) -> Iterator[tuple[int, str, str]]:
        """Yield every chunk of an array: (position of its shard, key of its file, file name in the store)."""
        table: Table = "scene" if field in self.schema.scene_fields else "sample"
        paths = chunk_paths(self.schema, self.layout, table, field)
        step = rows_per_shard(self.layout, table) // len(paths)
        for position, shard in enumerate(self.shards):
            wanted = shard.scenes if table == "scene" else shard.samples
            for i, path in enumerate(paths[: -(-wanted // step)]):
                yield position, f"{shard.folder}/{path}", chunk_key(field, position * len(paths) + i)


def read_contents(storage: Storage, check: bool = True) -> Contents:
    """Return the current content of a store over the run, or the merged runs, in `storage`.

    Rows are those of the committed planned shards in order, run after run. Rows beyond n are cut only at the
    end of the store.

    With `check`, InputError when a committed file is missing or of another size. Always when no shard is
    committed, when a commit names other files than a shard has, or when merged runs have different arrays.
    """
    runs = open_runs(storage)
    first = runs[0]
    for run in runs[1:]:
        _refuse_other_arrays(first, run)
    sealed: list[SealedRun] = []
    folders: list[tuple[int, str]] = []
    digest = RowsDigest()
    digests = [digest.hexdigest()]
    for run in runs:
        n, first_position = run.n, len(folders)
        below = f"{part_folder(run.manifest.spec_hash)}/" if len(runs) > 1 else ""
        expected = _files_of_a_shard(run)
        planned = (commit for commit in run.commits() if commit.shard < run.layout.shards_for(n))
        for commit in _checked(run, planned) if check else planned:
            _refuse_odd_files(run, commit, expected)
            folders.append((commit.shard, below + shard_folder(commit.shard, commit.attempt)))
            digest.add(run.manifest.spec_hash, commit)
            digests.append(digest.hexdigest())
        done = ShardRanges.of(shard for shard, _ in folders[first_position:])
        absent = ShardRanges.of(range(run.layout.shards_for(n))).without(done)
        if len(absent) > _MOST_MISSING:
            problem = f"{len(absent)} planned shards are missing, but a store lists at most {_MOST_MISSING}"
            fix = "Make more of them with `datagen resume`, or make a smaller run"
            raise InputError(run.storage.url, "plans", problem, fix)
        sealed.append(SealedRun(run, n, done, absent, first_position))
    if not folders:
        raise InputError(storage.url, "commits", "no shard is committed", "Make some with `datagen resume`")
    sealed = with_last(sealed)
    shards = tuple(
        SealedShard(folder, *part.rows_of(shard))
        for part in sealed
        for shard, folder in folders[part.first : part.first + len(part.shards)]
    )
    return Contents(storage, tuple(sealed), shards, tuple(digests), first.schema, first.layout)


def with_last(sealed: Sequence[SealedRun]) -> list[SealedRun]:
    """The runs of a store with the last one that has shards marked as such."""
    last = next((part for part in reversed(sealed) if part.shards), None)
    return [replace(part, is_last=part is last) for part in sealed]


def _checked(run: Run, commits: Iterator[Commit]) -> Iterator[Commit]:
    """The commits, after a check that their files exist; several at a time on an object store."""

    def check(commit: Commit) -> Commit:
        run.check_files(commit)
        return commit

    return run.storage.concurrent_map(check, commits)


def _refuse_other_arrays(first: Run, run: Run) -> None:
    ours, theirs = first.schema, run.schema
    pairs = {
        "schema_name": (ours.name, theirs.name),
        "schema_version": (ours.version, theirs.version),
        "layout": (first.layout, run.layout),
        "spec": (dict(ours.sizes), dict(theirs.sizes)),
    }
    for field, (one, other) in pairs.items():
        if one != other:
            raise InputError(
                f"{run.storage.url}/manifest.json",
                field,
                f"is {other}, but {one} in {first.storage.url}: one store cannot hold both",
                "Read them as separate runs",
            )


def _files_of_a_shard(run: Run) -> frozenset[str]:
    schema, layout = run.schema, run.layout
    chunks = (chunk_paths(schema, layout, table, field) for table, field in schema.fields)
    return frozenset(chain(group_metadata(schema, layout, run.manifest.spec_hash), *chunks))


def _refuse_odd_files(run: Run, commit: Commit, expected: frozenset[str]) -> None:
    odd = sorted(expected ^ {entry.path for entry in commit.files})
    if odd:
        raise InputError(
            f"{run.storage.url}/{shard_folder(commit.shard, commit.attempt)}",
            "files",
            f"{len(odd)} files are missing or extra, first {odd[0]}",
            REPAIR,
        )


SEALED = "data.zarr"
ROOT = "zarr.json"


class SealedPart(BaseModel):
    """One run in a sealed store: the samples wanted, and the missing shards."""

    spec_hash: str
    n: int
    missing_shards: list[int]


class SealedRoot(BaseModel):
    """The content of the root zarr.json of a sealed store; one part for a single run."""

    parts: list[SealedPart]
    # sha256 over the digests of all files of its shards, in order; "" where unknown.
    rows_sha256: str = ""

    def part(self, spec_hash: str) -> SealedPart | None:
        return next((part for part in self.parts if part.spec_hash == spec_hash), None)


def sealed_root(storage: Storage) -> SealedRoot | None:
    """Read the root of data.zarr in `storage`; None where it does not exist or has another form."""
    data = storage.get(f"{SEALED}/{ROOT}", MAX_RECORD_BYTES)
    if data is None:
        return None
    try:
        attributes = json.loads(data)["attributes"]
        if "parts" not in attributes:  # a single run
            attributes = {"parts": [attributes], "rows_sha256": attributes.get("rows_sha256", "")}
        return SealedRoot.model_validate(attributes)
    except (ValueError, KeyError, TypeError, RecursionError, ValidationError):
        return None


def sealed_metadata(contents: Contents) -> dict[str, bytes]:
    """zarr.json files of the store by path; the root's has consolidated metadata."""
    first = contents.runs[0]
    attributes = root_attributes(contents.schema, contents.layout, first.run.manifest.spec_hash)
    if contents.is_merged:
        del attributes["spec_hash"]
        attributes["parts"] = [_part(run) for run in contents.runs]
    else:
        attributes |= _part(first)
    attributes["rows_sha256"] = contents.digests[-1]
    rows = {table: contents.rows(table) for table in TABLES}
    specs = [part.run.manifest.spec for part in contents.runs]
    attributes = described(specs, [part.n for part in contents.runs]) | attributes
    of_arrays = {f.name: cf_attributes(f, table) for table, f in contents.schema.fields}
    files = zarr_metadata(contents.schema, contents.layout, rows, attributes, of_arrays)
    make = default_buffer_prototype().buffer.from_bytes
    store = {path: make(data) for path, data in files.items()}
    with warnings.catch_warnings():
        # Consolidated metadata is not in the Zarr v3 specification yet; common readers support it.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(MemoryStore(store), zarr_format=3)
    return {path: buffer.to_bytes() for path, buffer in store.items()}


def _part(sealed: SealedRun) -> dict[str, Any]:
    return {
        "spec_hash": sealed.run.manifest.spec_hash,
        "n": sealed.n,
        "shards": len(sealed.shards),
        "missing_shards": list(sealed.missing_shards),
        "specification": sealed.run.manifest.spec.document(),
    }
