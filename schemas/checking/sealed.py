"""Checks of the sealed store against its shards."""

from __future__ import annotations

import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import sha256

from datagen.schemas.checking.finding import Finding, Reseal, curable
from datagen.schemas.checking.shards import ShardForm, same_json
from datagen.schemas.errors import InputError
from datagen.schemas.keys import shard_folder
from datagen.schemas.record_files import MAX_RECORD_BYTES
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.sealing.contents import MOST_SHARDS, Contents, RowsDigest, SealedRun, SealedShard
from datagen.schemas.sealing.metadata import ROOT, SEALED, SealedRoot, sealed_metadata, sealed_root
from datagen.schemas.shard_files import TABLES, chunk_key, rows_per_shard
from datagen.schemas.storage import Storage


@dataclass(frozen=True)
class SealedSlice:
    """The shards of one run that the store names: the position of each, and the cut of the last."""

    n: int
    missing: tuple[int, ...]
    positions: Mapping[int, int]  # shard -> its position in the store
    cut: Mapping[int, tuple[int, int]]  # shard -> (scenes, samples) where it is cut

    def wanted(self, shard: int, run: Run) -> tuple[int, int]:
        """(scenes, samples) of a shard in the store."""
        return self.cut.get(shard, (run.layout.scenes_per_shard, run.layout.samples_per_shard))


@dataclass
class SealedTally:
    """The expected content of the store, collected shard by shard in order."""

    digest: RowsDigest = field(default_factory=RowsDigest)
    shards: list[SealedShard] = field(default_factory=list[SealedShard])
    lost: int = 0  # shards without a commit
    unknown: int = 0  # shards without any file

    def add(self, run: Run, slice_: SealedSlice, shard: int, commit: Commit | None, known: bool) -> None:
        """Count one shard of the store; `known` where it has files but no commit."""
        if commit is None:
            self.lost, self.unknown = self.lost + known, self.unknown + (not known)
            return
        scenes, samples = slice_.wanted(shard, run)
        self.shards.append(SealedShard(shard_folder(shard, commit.attempt), scenes, samples))
        self.digest.add(run.manifest.spec_hash, commit)


def read_root(
    place: Storage, runs: Iterable[Run], wanted: Mapping[str, int]
) -> tuple[SealedRoot | None, list[Finding]]:
    """Return the metadata of data.zarr; a finding where it exists and is impossible.

    `wanted` are the samples of the newest plans, by specification hash.
    """
    key = f"{SEALED}/{ROOT}"
    try:
        root = sealed_root(place)
        there = root is not None or next(iter(place.list(SEALED)), None) is not None
    except InputError as error:
        return None, [curable(key, "sealed", error.problem, Reseal())]
    if root is None:
        if there:  # in an object store, possibly unfinished
            return None, [curable(key, "sealed", "missing, or without the list of its shards", Reseal())]
        return None, []
    told = {part.spec_hash: part.n for part in root.parts}
    if told.keys() - wanted.keys() or any(not 0 < n <= wanted[spec] for spec, n in told.items()):
        problem = "names rows that no plan wants"
        return None, [curable(key, "sealed", problem, Reseal())]
    layouts = {run.manifest.spec_hash: run.layout for run in runs}
    held = sum(layouts[part.spec_hash].shards_for(part.n) - len(part.missing_shards) for part in root.parts)
    if held > MOST_SHARDS:  # before memory is allocated for them
        problem = f"names {held} shards, more than a store can have"
        return None, [curable(key, "sealed", problem, Reseal())]
    return root, []


def slices_of(root: SealedRoot, runs: Iterable[Run]) -> dict[str, SealedSlice]:
    """The shards of each run in the store, by specification hash."""
    found: dict[str, SealedSlice] = {}
    before = 0
    last: tuple[str, int] | None = None
    held: dict[str, tuple[Run, int, tuple[int, ...], dict[int, int]]] = {}
    for run in runs:
        part = root.part(run.manifest.spec_hash)
        if part is None:
            continue
        missing = set(part.missing_shards)
        shards = [k for k in range(run.layout.shards_for(part.n)) if k not in missing]
        positions = {shard: before + i for i, shard in enumerate(shards)}
        before += len(shards)
        held[run.manifest.spec_hash] = (run, part.n, tuple(sorted(missing)), positions)
        if shards:
            last = run.manifest.spec_hash, shards[-1]
    for spec_hash, (run, n, missing, positions) in held.items():
        cut: dict[int, tuple[int, int]] = {}
        if last is not None and last[0] == spec_hash:
            cut[last[1]] = run.layout.rows_wanted(last[1], n)
        found[spec_hash] = SealedSlice(n, missing, positions, cut)
    return found


def check_chunks(
    place: Storage, prefix: str, run: Run, form: ShardForm, slice_: SealedSlice, commit: Commit
) -> Iterator[Finding]:
    """Check the store's chunks of one shard: links to its files, or equal bytes."""
    folder = f"{prefix}{shard_folder(commit.shard, commit.attempt)}"
    entries = {entry.path: entry for entry in commit.files}
    wanted = dict(zip(TABLES, slice_.wanted(commit.shard, run), strict=True))
    for table in TABLES:
        rows = rows_per_shard(run.layout, table)
        for array in form.schema.table(table):
            paths = form.chunks[array.name]
            step = rows // len(paths)
            for i in range(-(-wanted[table] // step)):
                number = slice_.positions[commit.shard] * len(paths) + i
                key = f"{SEALED}/{array.name}/{chunk_key(array, number)}"
                entry = entries.get(paths[i])
                if entry is None or _is_link(place, key, f"{folder}/{entry.path}"):
                    continue
                most = min(entry.size, form.most_bytes(paths[i]))
                if problem := _other_bytes(place, key, most, entry.sha256):
                    cure = Reseal(source=f"{folder}/{entry.path}")
                    yield curable(key, "sealed", problem, cure, commit.shard)


def _is_link(place: Storage, key: str, source: str) -> bool:
    if place.folder is None:
        return False
    try:
        one, other = (place.folder / key).lstat(), (place.folder / source).lstat()
    except OSError:
        return False
    return stat.S_ISREG(one.st_mode) and (one.st_dev, one.st_ino) == (other.st_dev, other.st_ino)


def _other_bytes(place: Storage, key: str, size: int, digest: str) -> str:
    try:
        data = place.get(key, size)
    except InputError as error:
        return error.problem
    if data is None:
        return "missing"
    return "" if sha256(data).hexdigest() == digest else "has other bytes than its shard"


def check_store(
    place: Storage,
    runs: list[Run],
    wanted: Mapping[str, int],
    slices: Mapping[str, SealedSlice],
    tally: SealedTally,
) -> Iterator[Finding]:
    """Check the store's metadata, extra files, and whether it is outdated."""
    if tally.unknown:
        problem = f"holds {tally.unknown} shards without any file in the run"
        yield curable(SEALED, "sealed", problem, Reseal())
    if tally.lost:  # their rows exist only here: do not seal again
        problem = f"holds {tally.lost} shards whose commits are lost: it cannot be checked"
        fix = "Make the shards again with `datagen resume`, which seals them with the others"
        yield Finding(SEALED, "sealed", problem, fix)
    if tally.unknown or tally.lost:
        return
    sealed = tuple(
        SealedRun(run, part.n, tuple(part.positions), part.missing)
        for run in runs
        if (part := slices.get(run.manifest.spec_hash)) is not None
    )
    first = sealed[0].run
    digests = (tally.digest.hexdigest(),)
    contents = Contents(place, sealed, tuple(tally.shards), digests, first.schema, first.layout)
    older = sealed_metadata(contents, for_readers=False)
    for path, data in sealed_metadata(contents).items():
        key = f"{SEALED}/{path}"
        try:
            there = place.get(key, MAX_RECORD_BYTES)
            problem = "missing" if there is None else ""
            if there is not None and not (same_json(there, data) or same_json(there, older[path])):
                problem = "differs from what sealing these shards writes"
        except InputError as error:
            problem = error.problem
        if problem:
            yield curable(key, "sealed", problem, Reseal(data=data))
    yield from _foreign_files(contents)
    if any(_is_behind(run, wanted[run.manifest.spec_hash], slices) for run in runs):
        fix = "Run datagen seal to update it; nothing is damaged"
        yield Finding(SEALED, "stale", "is older than the committed shards", fix)


def _is_behind(run: Run, n: int, slices: Mapping[str, SealedSlice]) -> bool:
    part = slices.get(run.manifest.spec_hash)
    return part is None or part.n != n or bool(run.committed() & set(part.missing))


def _foreign_files(contents: Contents) -> Iterator[Finding]:
    known = {f"{SEALED}/{ROOT}"}
    counts: dict[str, int] = {}
    fields = {f.name: f for table in TABLES for f in contents.schema.table(table)}
    for table in TABLES:
        for array in contents.schema.table(table):
            known.add(f"{SEALED}/{array.name}/zarr.json")
            # Only the last shard is cut, so chunks are numbered without gaps.
            counts[array.name] = sum(1 for _ in contents.chunks(array))
    for file in contents.place.list(SEALED):
        if file.key in known:
            continue
        names = file.key.split("/")
        number = names[2].split(".")[1] if len(names) == 3 and names[2].startswith("c.") else ""
        array = fields.get(names[1]) if number.isascii() and number.isdigit() and len(number) < 16 else None
        if array is None or names[2] != chunk_key(array, int(number)) or int(number) >= counts[array.name]:
            problem = "is not a file of the sealed store"
            yield curable(file.key, "sealed", problem, Reseal())
