"""Merge separate runs into one run, or into merged runs of several parts.

Objects and commits are copied as they are; each step skips what is there, so that an interrupted merge is
completed by running it again.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from datagen.schemas.errors import InputError
from datagen.schemas.merging.plan import (
    Part,
    Tick,
    divide_scenes,
    group_runs,
    identity,
    key_of,
    largest_plan,
    plan_part,
    refuse_incompatible,
)
from datagen.schemas.record_files import (
    MAX_RECORD_BYTES,
    MERGED,
    copy_key,
    encode_record,
    end_key,
    object_key,
    publish,
    refuse_foreign,
    superseded_end,
)
from datagen.schemas.run import Run, label_counts, open_runs
from datagen.schemas.run_records import Commit, Merged, MergedPart, Plan
from datagen.schemas.sealing import seal
from datagen.schemas.storage import Storage, open_storage

SPARE_CAUSE = "merged: this shard is kept from another attempt"
_ELSEWHERE = "Choose a new --out, and name this run among those to merge"


@dataclass(frozen=True, eq=False)
class MergePlan:
    """Runs that can be merged into `out`: their parts, and which scenes of each count."""

    out: str
    parts: tuple[Part, ...]
    scenes: tuple[MergedPart, ...]

    @property
    def records(self) -> int:
        """How many shards there are to write."""
        return sum(len(part.kept) for part in self.parts)


class WrittenPart(NamedTuple):
    """The result of a part. `there` counts shards that existed before, `spare` those of several sources."""

    run: Run
    there: int
    copied: int
    spare: int


class MergeResult(NamedTuple):
    """The result of a merge; `sealed` is the store's address, "" where nothing is committed."""

    storage: Storage
    written: tuple[WrittenPart, ...]
    sealed: str


def plan_merge(paths: Sequence[str], out: str, tick: Tick = lambda: None) -> MergePlan:
    """Plan a merge without writing; `tick` is called for every commit that was read.

    A run at `out` is one of the sources. InputError when there is nothing to merge, when runs are of
    different kinds, have different rows for a scene, or cannot be added to the run at `out`.
    """
    if not paths:
        raise InputError("datagen merge", "RUN", "is missing", "Name the runs to merge")
    storage, existing, is_merged = None, list[Run](), False
    try:
        storage = open_storage(out, probe=False, create=False)
        is_merged = storage.exists(MERGED)
        existing = open_runs(storage) if is_merged or storage.exists("manifest.json") else []
    except InputError as e:
        if e.problem != "no such folder":
            raise
    sources = [run for path in paths for run in open_runs(path)]
    refuse_incompatible([*existing, *sources])
    _refuse_nested(paths, out, existing, sources)
    groups = group_runs([*existing, *sources])
    if existing and not is_merged and len(groups) > 1:
        problem = "is one run, and cannot hold runs of another specification or size of shards"
        raise InputError(existing[0].storage.url, "manifest.json", problem, _ELSEWHERE)
    if storage is not None and not existing:
        # An interrupted merge may have left parts that no record names yet, and a draft of the record.
        refuse_foreign(storage, *(("parts/", MERGED) if len(groups) > 1 else ()))
    here = set(map(key_of, existing))
    parts = tuple(plan_part(group, key in here, tick) for key, group in groups.items())
    return MergePlan(out, parts, tuple(divide_scenes(parts)))


def merge_runs(merge: MergePlan, tick: Tick = lambda: None) -> MergeResult:
    """Write a planned merge and seal it; `tick` is called for every shard.

    Called again, it completes an interrupted merge, and changes nothing in a complete one. InputError where a
    source lacks a committed object, or it is damaged.
    """
    storage = open_storage(merge.out)
    is_one = len(merge.parts) == 1 and not storage.exists(MERGED)
    written: list[WrittenPart] = []
    for part in merge.parts:
        plan = largest_plan(one for one in merge.parts if one.key[0] == part.key[0])
        run = _begin(part, plan, storage if is_one else storage.below(part.folder))
        written.append(_write(part, run, tick))
    if not is_one:
        record = encode_record(Merged(parts=merge.scenes))
        for key in (copy_key(MERGED), MERGED):
            if storage.get(key, MAX_RECORD_BYTES) != record:
                storage.put(key, record)
    has_labels = label_counts(open_runs(storage)).labels > 0
    return MergeResult(storage, tuple(written), seal(storage) if has_labels else "")


def _begin(part: Part, plan: Plan, storage: Storage) -> Run:
    """Open the part's run with its manifest and plan, or create it."""
    if not storage.exists("manifest.json"):
        publish(storage, "manifest.json", encode_record(part.manifest))
    run = Run.open(storage)
    if key_of(run) != part.key:
        problem = f"is of another run than {part.folder}"
        raise InputError(f"{storage.url}/manifest.json", "spec_hash", problem, "Choose a new --out")
    run.grow(plan.n, plan.created)
    return run


def _write(part: Part, run: Run, tick: Tick) -> WrittenPart:
    storage, there = run.storage, run.committed()
    new = [(part.runs[source], commit) for shard, (source, commit) in part.kept.items() if shard not in there]

    def copy(one: tuple[Run, Commit]) -> None:
        source, commit = one
        if not storage.put_new(key := object_key(commit.attempt), source.read_object(commit)):
            problem = f"is another attempt of that name than in {source.storage.url}"
            raise InputError(f"{storage.url}/{key}", "", problem, _ELSEWHERE)
        run.commit(commit)

    for _ in storage.concurrent_map(copy, new):
        tick()
    others = [source for source in part.runs if identity(source) != identity(run)]
    _copy_records(others, run, {end_key(commit.attempt) for _, commit in part.kept.values()})
    for source, commit in part.spare:
        if run.commit_of(commit.shard).attempt != commit.attempt:
            start = part.runs[source].ledger.start_of(commit.attempt)
            run.ledger.end(superseded_end(commit, SPARE_CAUSE, start.started if start else ""))
    run.close_lost_attempts("")  # of shards that another source has
    return WrittenPart(run, len(there), len(new), len(part.spare))


def _copy_records(sources: Sequence[Run], run: Run, but: Container[str]) -> None:
    """Copy ledgers, but for some keys, and the quarantine of shards that are not committed.

    Of records of one name the fullest is kept, whatever the order of the sources.
    """
    there = {file.key for folder in ("ledger", "quarantine") for file in run.storage.list(folder)}
    held: dict[str, list[Run]] = {}
    for source in sources:
        keys = [file.key for file in source.storage.list("ledger") if file.key.endswith(".json")]
        keys += [f"quarantine/{shard:06d}.json" for shard in source.quarantined() - run.committed()]
        for key in keys:
            if key not in there and key not in but:
                held.setdefault(key, []).append(source)

    def put(pair: tuple[str, bytes | None]) -> None:
        key, data = pair
        for source in held[key][1:]:
            other = source.storage.get(key, MAX_RECORD_BYTES)
            data = max(filter(None, (data, other)), key=lambda one: (len(one), one), default=None)
        if data is not None:
            run.storage.put_new(key, data)

    for source in sources:
        keys = sorted(key for key, runs in held.items() if runs[0] is source)
        for _ in run.storage.concurrent_map(put, source.storage.get_many(keys, MAX_RECORD_BYTES)):
            pass


def _address(path: str) -> str:
    if path.startswith("s3://"):
        return path.rstrip("/")
    return str(Path(path.removeprefix("file://")).expanduser().resolve())


def _refuse_nested(paths: Sequence[str], out: str, existing: Sequence[Run], sources: Sequence[Run]) -> None:
    here, roots = _address(out), {_address(path) for path in paths}
    known = {here, *map(identity, existing)}
    for other in sorted({*roots, *map(identity, sources)} - known):
        if here.startswith(f"{other}/") or other.startswith(f"{here}/"):
            problem = f"is inside {other}" if here.startswith(other) else f"contains {other}"
            raise InputError(out, "--out", problem, "Choose another folder for the result")
