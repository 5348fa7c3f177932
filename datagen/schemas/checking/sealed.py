"""Checks of the sealed store against its shards."""

from __future__ import annotations

import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import sha256

from datagen.schemas.checking.attempts import CheckedShard
from datagen.schemas.checking.finding import Finding, Reseal, curable
from datagen.schemas.checking.shards import ShardForm, same_json
from datagen.schemas.errors import InputError
from datagen.schemas.fields import TABLES
from datagen.schemas.record_files import MAX_RECORD_BYTES, shard_folder
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, ShardRanges
from datagen.schemas.sealing.contents import (
    MOST_SHARDS,
    ROOT,
    SEALED,
    Contents,
    RowsDigest,
    SealedRoot,
    SealedRun,
    SealedShard,
    sealed_metadata,
    sealed_root,
    with_last,
)
from datagen.schemas.shard_files import chunk_key, rows_per_shard
from datagen.schemas.storage import Storage


@dataclass
class SealedTally:
    """The expected content of the store, collected shard by shard in order."""

    digest: RowsDigest = field(default_factory=RowsDigest)
    shards: list[SealedShard] = field(default_factory=list[SealedShard])
    lost: int = 0  # shards without a commit
    unknown: int = 0  # shards without any file

    def add(self, sealed: SealedRun, looked: CheckedShard) -> None:
        """Count one shard of the store. A shard without a commit has findings if it has files."""
        if looked.commit is None:
            has_files = bool(looked.findings)
            self.lost, self.unknown = self.lost + has_files, self.unknown + (not has_files)
            return
        folder = shard_folder(looked.shard, looked.commit.attempt)
        self.shards.append(SealedShard(folder, *sealed.rows_of(looked.shard)))
        self.digest.add(sealed.run.manifest.spec_hash, looked.commit)


def read_root(
    storage: Storage, runs: Iterable[Run], wanted: Mapping[str, int]
) -> tuple[SealedRoot | None, list[Finding]]:
    """Return the metadata of data.zarr; a finding where it exists and is invalid.

    `wanted` are the samples of the newest plans, by specification hash.
    """
    key = f"{SEALED}/{ROOT}"
    try:
        root = sealed_root(storage)
        there = root is not None or next(iter(storage.list(SEALED)), None) is not None
    except InputError as error:
        return None, [curable(key, "sealed", error.problem, Reseal())]
    if root is None:
        if there:  # in an object store, possibly unfinished
            return None, [curable(key, "sealed", "missing, or without the list of its shards", Reseal())]
        return None, []
    sealed_n = {part.spec_hash: part.n for part in root.parts}
    unplanned = sealed_n.keys() - wanted.keys()
    if not sealed_n or unplanned or any(not 0 < n <= wanted[spec] for spec, n in sealed_n.items()):
        problem = "names rows that no plan wants"
        return None, [curable(key, "sealed", problem, Reseal())]
    layouts = {run.manifest.spec_hash: run.layout for run in runs}
    held = sum(layouts[part.spec_hash].shards_for(part.n) - len(part.missing_shards) for part in root.parts)
    if held > MOST_SHARDS:  # before memory is allocated for them
        problem = f"names {held} shards, more than a store can have"
        return None, [curable(key, "sealed", problem, Reseal())]
    return root, []


def runs_named(root: SealedRoot, runs: Iterable[Run]) -> dict[str, SealedRun]:
    """The runs that the store names, with their shards in it, by specification hash."""
    found: list[SealedRun] = []
    before = 0
    for run in runs:
        if (part := root.part(run.manifest.spec_hash)) is None:
            continue
        planned = range(run.layout.shards_for(part.n))
        missing = ShardRanges.of(k for k in part.missing_shards if k in planned)
        held = ShardRanges.of(planned).without(missing)
        found.append(SealedRun(run, part.n, held, missing, before))
        before += len(found[-1].shards)
    return {part.run.manifest.spec_hash: part for part in with_last(found)}


def check_chunks(
    storage: Storage, prefix: str, form: ShardForm, sealed: SealedRun, commit: Commit
) -> Iterator[Finding]:
    """Check the store's chunks of one shard: links to its files, or equal bytes."""
    folder = f"{prefix}{shard_folder(commit.shard, commit.attempt)}"
    entries = {entry.path: entry for entry in commit.files}
    wanted = dict(zip(TABLES, sealed.rows_of(commit.shard), strict=True))
    position = sealed.position_of(commit.shard)
    for table, array in form.schema.fields:
        paths = form.chunks[array.name]
        step = rows_per_shard(sealed.run.layout, table) // len(paths)
        for i, path in enumerate(paths[: -(-wanted[table] // step)]):
            key = f"{SEALED}/{array.name}/{chunk_key(array, position * len(paths) + i)}"
            entry = entries.get(path)
            if entry is None or _is_link(storage, key, f"{folder}/{path}"):
                continue
            if problem := _other_bytes(storage, key, min(entry.size, form.most_bytes(path)), entry.sha256):
                yield curable(key, "sealed", problem, Reseal(), commit.shard)


def _is_link(storage: Storage, key: str, source: str) -> bool:
    if storage.folder is None:
        return False
    try:
        one, other = (storage.folder / key).lstat(), (storage.folder / source).lstat()
    except OSError:
        return False
    return stat.S_ISREG(one.st_mode) and (one.st_dev, one.st_ino) == (other.st_dev, other.st_ino)


def _other_bytes(storage: Storage, key: str, size: int, digest: str) -> str:
    try:
        data = storage.get(key, size)
    except InputError as error:
        return error.problem
    if data is None:
        return "missing"
    return "" if sha256(data).hexdigest() == digest else "has other bytes than its shard"


def check_store(
    storage: Storage,
    runs: list[Run],
    wanted: Mapping[str, int],
    sealed: Mapping[str, SealedRun],
    tally: SealedTally,
) -> Iterator[Finding]:
    """Check the store's metadata, extra files, and whether it is outdated."""
    if tally.unknown:
        problem = f"holds {tally.unknown} shards without any file in the run"
        yield curable(SEALED, "sealed", problem, Reseal())
    if tally.lost:
        problem = f"holds {tally.lost} shards whose commits are lost: it cannot be checked"
        yield curable(SEALED, "sealed", problem, Reseal())
    if tally.unknown or tally.lost:
        return
    parts = tuple(sealed.values())
    first, digests = parts[0].run, (tally.digest.hexdigest(),)
    contents = Contents(storage, parts, tuple(tally.shards), digests, first.schema, first.layout)
    for path, data in sealed_metadata(contents).items():
        key = f"{SEALED}/{path}"
        try:
            there = storage.get(key, MAX_RECORD_BYTES)
            problem = "missing" if there is None else ""
            if there is not None and not same_json(there, data):
                problem = "differs from what sealing these shards writes"
        except InputError as error:
            problem = error.problem
        if problem:
            yield curable(key, "sealed", problem, Reseal())
    yield from _foreign_files(contents)
    if any(_is_behind(run, wanted[run.manifest.spec_hash], sealed) for run in runs):
        yield curable(SEALED, "stale", "is older than the committed shards; nothing is damaged", Reseal())


def _is_behind(run: Run, n: int, sealed: Mapping[str, SealedRun]) -> bool:
    part = sealed.get(run.manifest.spec_hash)
    return part is None or part.n != n or any(k in part.missing_shards for k in run.committed())


def _foreign_files(contents: Contents) -> Iterator[Finding]:
    fields = {f.name: f for _, f in contents.schema.fields}
    known = {f"{SEALED}/{ROOT}", *(f"{SEALED}/{name}/{ROOT}" for name in fields)}
    # Only the last shard is cut, so chunks are numbered without gaps.
    counts = {name: sum(1 for _ in contents.chunks(field)) for name, field in fields.items()}
    for file in contents.storage.list(SEALED):
        if file.key in known:
            continue
        names = file.key.split("/")
        number = names[2].split(".")[1] if len(names) == 3 and names[2].startswith("c.") else ""
        array = fields.get(names[1]) if number.isascii() and number.isdigit() and len(number) < 16 else None
        if array is None or names[2] != chunk_key(array, int(number)) or int(number) >= counts[array.name]:
            yield curable(file.key, "sealed", "is not a file of the sealed store", Reseal())
