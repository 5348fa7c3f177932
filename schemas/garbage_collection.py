"""What a run holds and nothing names: found, and removed without taking what is or becomes committed.

An attempt and the removal of its files race for one commit. Neither can lock the other out, as stores know
no transaction over two keys; so each first leaves its mark and then looks for the other's:

    removal                                         commit
    1 writes `removing` into the attempt's folder   1 finds its files whole and no `removing`
    2 reads the shard's commit: where it names      2 puts the commit record, create-only
      the attempt, takes `removing` back, is done   3 finds its files whole and no `removing`;
    3 removes the files                               else takes its record back, and fails
    4 reads the commit again, to tell if it names
      what is gone; removes `removing` last

Whichever mark is written second is seen by its writer's look: a commit that stands has its files. What
remains is an attempt that dies between its steps 2 and 3 while its files are being removed: that commit
names files which are gone, step 4 or `verify` says so, and `repair` makes the shard again. It takes an
attempt as old as `older_than` for that. A removal that was cut short goes on when it is called again.
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
    """A file, or a folder with all its files, that nothing names."""

    storage: Storage  # of the run or of the merged place that holds it
    kind: Kind
    key: str
    files: int
    bytes: int
    folder: bool = False
    attempt: tuple[int, str] | None = None  # shard and name, where it is an attempt's folder


@dataclass(frozen=True)
class Swept:
    """What was removed."""

    files: int = 0
    bytes: int = 0
    spared: int = 0  # attempts that were committed after they were found
    damaged: tuple[str, ...] = ()  # commits whose files were removed in spite of all

    def plus(self, other: Swept) -> Swept:
        """Both together."""
        return Swept(
            self.files + other.files,
            self.bytes + other.bytes,
            self.spared + other.spared,
            self.damaged + other.damaged,
        )


def find_garbage(
    place: Storage, older_than_s: float, now_s: float, seen: Seen = lambda done, of: None
) -> list[Garbage]:
    """Garbage of a place, last written more than `older_than_s` before `now_s` (seconds since 1970 UTC).

    While jobs are at work there, what was written since the first of them began is left alone, whatever
    its age. `seen` hears of (shards looked at, shards). InputError where there is no run.
    """
    runs = open_runs(place)
    began = [_seconds(job.record.started) for job in Jobs(place).all() if job.health() in ("live", "silent")]
    before_s = min([now_s - older_than_s, *began])
    found: list[Garbage] = []
    for run in runs:
        found += _of_run(run, before_s, seen)
    if all(run.storage.url != place.url for run in runs):  # a merged place
        rest = (file for file in place.list("") if not file.key.startswith("parts/"))
        found += _loose(place, rest, set(), before_s)
    return found


def sweep(garbage: Garbage) -> Swept:
    """Remove one piece of garbage; attempts that were committed meanwhile are spared."""
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
    # Which shards are committed is asked before what there is: what is committed in between is seen
    # when its attempt is about to be removed.
    committed = run.committed()
    started = {
        file.key.removeprefix("ledger/").removesuffix(".start.json"): file.modified_s
        for file in storage.list("ledger")
        if file.key.endswith(".start.json")
    }
    spent, passed = set(unreadable_files(run)), 0
    for key, group in groupby(storage.list(""), key=_folder_of):
        if not (found := _ATTEMPT.fullmatch(f"{key}/")):
            yield from _loose(storage, group, spent, before_s)
            continue
        files = list(group)
        shard, name = int(found[1]), found[2]
        passed += 1
        seen(min(passed, len(committed)), len(committed))
        newest_s = max([started.get(name, 0.0), *(file.modified_s for file in files)])
        if shard in committed and _winner(run, shard) in (name, None):
            # Only what a removal or a killed writer left in the folder that is named.
            left = [file for file in files if file.key == f"{key}/{REMOVING}" or _DRAFT.fullmatch(file.key)]
            yield from (_one(storage, "drafts", file) for file in left if file.modified_s < before_s)
        elif newest_s < before_s and not (shard not in committed and _has_claim(shard, name, files)):
            size = sum(file.size for file in files)
            yield Garbage(storage, "attempts", key, len(files), size, True, (shard, name))


def _has_claim(shard: int, name: str, files: Iterable[StoredFile]) -> bool:
    """Whether the commit record may have been lost: `repair` restores it from the claim in the folder."""
    return any(file.key == commit_copy_key(shard, name) for file in files)


def _winner(run: Run, shard: int) -> str | None:
    """The attempt that a shard's commit names; None where the record is damaged or just went."""
    try:
        return run.commit_of(shard).attempt
    except InputError:
        return None


def _folder_of(file: StoredFile) -> str:
    """The folder that is removed or kept as a whole, or "" for a file by itself."""
    for folder in (_ATTEMPT, _STORE_DRAFT):
        if found := folder.match(file.key):
            return found[0].rstrip("/")
    return ""


def _loose(
    storage: Storage, files: Iterable[StoredFile], spent: set[str], before_s: float
) -> Iterator[Garbage]:
    """Garbage among files outside the attempts' folders, which are those of one draft, or by themselves."""
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
        elif file.key in spent:
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
        return 0.0  # since when it works is not known: nothing is old enough
