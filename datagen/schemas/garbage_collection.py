"""Find and remove garbage of a run, without removing files of attempts that are or become committed.

An attempt and the removal of its files race for one commit. Stores have no transactions over two keys, so
each first writes its mark and then checks for the other's:

    removal                                         commit
    1 writes `removing` into the attempt's folder   1 finds its files whole and no `removing`
    2 reads the shard's commit: where it names      2 puts the commit record, create-only
      the attempt, removes `removing` and ends      3 finds its files whole and no `removing`;
    3 removes the files                               else removes its record, and fails
    4 reads the commit again, to report one with
      missing files; removes `removing` last

The writer of the second mark sees the first one, so a surviving commit has its files. One case remains: an
attempt dies between its steps 2 and 3 while its files are removed. Its commit then names missing files,
which step 4 or `verify` reports, and `repair` makes the shard again. This needs an attempt older than
`older_than`. An interrupted removal is completed by the next call.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from typing import Literal

from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Jobs
from datagen.schemas.keys import REMOVING, commit_copy_key, commit_key
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.run import Run
from datagen.schemas.storage import Storage, StoredFile
from datagen.schemas.summaries import unreadable_files

Seen = Callable[[int, int], None]
Kind = Literal["attempts", "drafts", "probes", "index"]
KINDS: tuple[Kind, ...] = ("attempts", "drafts", "probes", "index")
_ATTEMPT = re.compile(r"shards/([0-9]{6,18})/([A-Za-z0-9][A-Za-z0-9_.-]{0,99})/")
_DRAFT = re.compile(r".+\.[0-9a-f]{16}\.part")
_STORE_DRAFT = re.compile(r"(data\.zarr\.[0-9a-f]{16}\.partial)/")
_PROBE = re.compile(r"\.probe-[0-9a-f]{16}(?:\.[0-9a-f]{16}\.part)?")


@dataclass(frozen=True)
class Garbage:
    """A file, or a folder with all its files, that no record names."""

    storage: Storage  # of the run, or of the merged runs, that hold it
    kind: Kind
    key: str
    files: int
    bytes: int
    folder: bool = False
    attempt: tuple[int, str] | None = None  # shard and name, where it is an attempt's folder


@dataclass(frozen=True)
class Swept:
    """The result of a removal."""

    files: int = 0
    bytes: int = 0
    spared: int = 0  # attempts that were committed meanwhile
    damaged: tuple[str, ...] = ()  # commits whose files were removed nevertheless

    def plus(self, other: Swept) -> Swept:
        return Swept(
            self.files + other.files,
            self.bytes + other.bytes,
            self.spared + other.spared,
            self.damaged + other.damaged,
        )


def find_garbage(
    storage: Storage, older_than_s: float, now_s: float, seen: Seen = lambda done, of: None
) -> list[Garbage]:
    """List garbage last written more than `older_than_s` before `now_s` (seconds since 1970 UTC).

    While jobs run, files written since the first of them began are kept, whatever their age. `seen` is called
    with (searched shards, shards). InputError where there is no run.
    """
    runs = open_runs(storage)
    running = [job.record for job in Jobs(storage).all() if job.health() in ("live", "silent")]
    began = [_seconds(job.started) for job in running]
    before_s = min([now_s - older_than_s, *began])
    found: list[Garbage] = []
    for run in runs:
        found += _of_run(run, before_s, seen)
    if all(run.storage.url != storage.url for run in runs):  # merged runs
        rest = (file for file in storage.list("") if not file.key.startswith("parts/"))
        found += _loose(storage, rest, set(), before_s)
    return found


def sweep(garbage: Garbage) -> Swept:
    """Remove one item of garbage; attempts that were committed meanwhile are kept."""
    if garbage.attempt is not None:
        shard, name = garbage.attempt
        done = Run.open(garbage.storage).remove_attempt(shard, name)
        if done == "spared":
            return Swept(spared=1)
        damaged = (commit_key(shard),) if done == "damaged" else ()
        return Swept(garbage.files, garbage.bytes, damaged=damaged)
    if garbage.folder:
        garbage.storage.delete([file.key for file in garbage.storage.list(garbage.key)])
        garbage.storage.remove_empty(garbage.key)
    else:
        garbage.storage.delete([garbage.key])
    return Swept(garbage.files, garbage.bytes)


def _of_run(run: Run, before_s: float, seen: Seen) -> Iterator[Garbage]:
    storage = run.storage
    # Commits are listed before files: a commit in between is noticed before its attempt is removed.
    committed = run.committed()
    started = {
        file.key.removeprefix("ledger/").removesuffix(".start.json"): file.modified_s
        for file in storage.list("ledger")
        if file.key.endswith(".start.json")
    }
    unreadable, searched = set(unreadable_files(run)), 0
    for key, group in groupby(storage.list(""), key=_folder_of):
        if not (found := _ATTEMPT.fullmatch(f"{key}/")):
            yield from _loose(storage, group, unreadable, before_s)
            continue
        files = list(group)
        shard, name = int(found[1]), found[2]
        searched += 1
        seen(min(searched, len(committed)), len(committed))
        newest_s = max([started.get(name, 0.0), *(file.modified_s for file in files)])
        if shard in committed and _winner(run, shard) in (name, None):
            # In a committed attempt's folder, only leftovers of a removal or a killed writer are garbage.
            left = [file for file in files if file.key == f"{key}/{REMOVING}" or _DRAFT.fullmatch(file.key)]
            yield from (_one(storage, "drafts", file) for file in left if file.modified_s < before_s)
        elif newest_s < before_s:
            if shard not in committed and any(file.key == commit_copy_key(shard, name) for file in files):
                continue  # its commit record may be lost: `repair` restores it from the copy
            size = sum(file.size for file in files)
            yield Garbage(storage, "attempts", key, len(files), size, True, (shard, name))


def _winner(run: Run, shard: int) -> str | None:
    """The attempt that a shard's commit names; None where the record is damaged or missing."""
    try:
        return run.commit_of(shard).attempt
    except InputError:
        return None


def _folder_of(file: StoredFile) -> str:
    """The folder that is removed or kept as a whole, or "" for a single file."""
    for folder in (_ATTEMPT, _STORE_DRAFT):
        if found := folder.match(file.key):
            return found[0].rstrip("/")
    return ""


def _loose(
    storage: Storage, files: Iterable[StoredFile], unreadable: set[str], before_s: float
) -> Iterator[Garbage]:
    """Garbage outside the attempts' folders: drafts of stores, and single files."""
    drafted: dict[str, list[StoredFile]] = {}
    for file in files:
        if found := _STORE_DRAFT.match(file.key):
            drafted.setdefault(found[1], []).append(file)
        elif file.modified_s >= before_s:
            continue
        elif _PROBE.fullmatch(file.key):
            yield _one(storage, "probes", file)
        elif _DRAFT.fullmatch(file.key):
            yield _one(storage, "drafts", file)
        elif file.key in unreadable:
            yield _one(storage, "index", file)
    for key, parts in drafted.items():
        if max(file.modified_s for file in parts) < before_s:
            yield Garbage(storage, "drafts", key, len(parts), sum(file.size for file in parts), True)


def _one(storage: Storage, kind: Kind, file: StoredFile) -> Garbage:
    return Garbage(storage, kind, file.key, 1, file.size)


def _seconds(text: str) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        return 0.0  # its start is unknown: nothing is old enough
