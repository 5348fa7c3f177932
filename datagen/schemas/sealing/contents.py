"""The content of a sealed store: the shards in order, and the record that names the store."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256

from pydantic import Field

from datagen.schemas.errors import InputError
from datagen.schemas.fields import RecordSchema, Table
from datagen.schemas.record_files import read_record
from datagen.schemas.run import Rows, Run
from datagen.schemas.run_records import (
    FORMAT_VERSION,
    Commit,
    Cost,
    Digest,
    FileEntry,
    Host,
    Layout,
    Ranges,
    StoredRecord,
)
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage

SEALED = "data.zarr"
RECORD = "data.json"


class SealedPart(StoredRecord):
    """One run in a sealed store: the samples wanted of it, and its missing shards."""

    spec_hash: Digest
    scenes_per_shard: int
    n: int = Field(ge=1, le=10**12)
    samples: int = Field(ge=0)
    missing: Ranges


class StoreRecord(StoredRecord):
    """data.json: the sealed store that counts, what it was made from, and its files.

    `rows_sha256` is over the digests of its shards, in order.
    """

    format_version: int = FORMAT_VERSION
    name: str = Field(pattern=r"^data(-[1-9][0-9]{0,8})?\.zarr$")
    rows_sha256: Digest
    parts: tuple[SealedPart, ...] = Field(min_length=1)
    files: tuple[FileEntry, ...]

    def part_of(self, run: Run) -> SealedPart | None:
        key = run.manifest.spec_hash, run.layout.scenes_per_shard
        return next((part for part in self.parts if (part.spec_hash, part.scenes_per_shard) == key), None)


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
    for run in runs[1:]:
        _refuse_other_arrays(first, run)
    held: list[tuple[Run, int, tuple[Commit, ...]]] = []
    for run in runs:
        planned = run.planned(n := run.n)
        held.append((run, n, tuple(map(_in_brief, (c for c in run.commits() if c.shard in planned)))))
    last = max((k for k, (_, _, commits) in enumerate(held) if commits), default=None)
    if last is None:
        place = first.storage.url
        raise InputError(place, "commits", "no shard is committed", "Make some with `datagen resume`")
    sealed = tuple(SealedRun(run, n, commits, k == last) for k, (run, n, commits) in enumerate(held))
    layout = max((run.layout for run in runs), key=lambda layout: layout.scenes_per_shard)
    return Contents(sealed, first.schema, layout)


_NO_HOST = Host(name="", cpu="", cores=0, memory_bytes=0)
_LEFT_OUT = {"cost": Cost(wall_s=0, cpu_s=0), "host": _NO_HOST, "redraws": {}}


def _in_brief(commit: Commit) -> Commit:
    """The commit without cost and machine, most of its memory: those of all shards are held."""
    return commit.model_copy(update=_LEFT_OUT)


def _refuse_other_arrays(first: Run, run: Run) -> None:
    ours, theirs = first.schema, run.schema
    pairs = {
        "schema_name": (ours.name, theirs.name),
        "schema_version": (ours.version, theirs.version),
        "candidates_per_scene": (first.layout.candidates_per_scene, run.layout.candidates_per_scene),
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
