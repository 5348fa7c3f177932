"""Merge separate runs into one run, or into merged runs of several parts, with links where possible."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.merging.plan import Union, common_layout, plan_union, refuse_incompatible
from datagen.schemas.merging.writing import WrittenUnion, begin_union, replace_record, write_union
from datagen.schemas.record_files import MAX_RECORD_BYTES, MERGED, encode_record, part_folder, refuse_foreign
from datagen.schemas.run import Run, label_counts, open_runs
from datagen.schemas.run_records import Layout, Merged
from datagen.schemas.sealing import SEALED, seal, sealed_metadata
from datagen.schemas.sealing.contents import read_contents
from datagen.schemas.storage import Storage, open_storage

_ELSEWHERE = "Choose a new --out, and name this run among those to merge"


@dataclass(frozen=True, eq=False)
class MergePlan:
    """Runs that can be merged: one union per specification, by ascending hash."""

    out: str
    existing: tuple[Run, ...]  # runs at `out` before the merge
    unions: tuple[Union, ...]
    hashes: tuple[str, ...]  # of all specifications in the result

    @property
    def is_ordinary(self) -> bool:
        """Whether the result is one run; else it has several parts."""
        return len(self.hashes) == 1

    @property
    def records(self) -> int:
        """Upper bound of the shards and attempts to write: duplicates count in each source."""
        return sum(len(union.kept) + sum(map(len, union.attempts)) for union in self.unions)


@dataclass(frozen=True, eq=False)
class MergeResult:
    """The result of a merge; `sealed` is the store's address, "" where nothing is committed."""

    storage: Storage
    written: tuple[WrittenUnion, ...]
    sealed: str


def plan_merge(paths: Sequence[str], out: str, tick: Callable[[], None] = lambda: None) -> MergePlan:
    """Plan a merge without writing; `tick` is called for every commit that was read.

    A run at `out` is one of the sources. InputError when there is nothing to merge, when runs are of
    different kinds, have different rows for a scene, or cannot be added to the run at `out`.
    """
    if not paths:
        raise InputError("datagen merge", "RUN", "is missing", "Name the runs to merge")
    storage = _existing_storage(out)
    has_runs = storage is not None and any(map(storage.exists, ("manifest.json", MERGED)))
    existing = open_runs(storage) if storage is not None and has_runs else []
    sources = list({_identity(run.storage): run for path in paths for run in open_runs(path)}.values())
    refuse_incompatible(sources)
    if existing:
        refuse_incompatible([existing[0], *sources])
    _refuse_nested(paths, out, existing, sources)
    named = {_identity(run.storage) for run in existing}
    groups: dict[str, list[Run]] = {run.manifest.spec_hash: [run] for run in existing}
    for run in sources:
        if _identity(run.storage) not in named:
            groups.setdefault(run.manifest.spec_hash, []).append(run)
    layout = common_layout(run.layout for group in groups.values() for run in group)
    hashes = tuple(sorted(groups))
    _refuse_unfit_output(existing, hashes, layout)
    if storage is not None and not existing:
        # An interrupted merge may have left parts that no record names yet, and a draft of the record.
        refuse_foreign(storage, *(("parts/", MERGED) if len(hashes) > 1 else ()))
    here = {run.manifest.spec_hash for run in existing}
    unions = tuple(
        plan_union(groups[spec_hash], 0 if spec_hash in here else None, layout, tick)
        for spec_hash in hashes
        if spec_hash not in here or len(groups[spec_hash]) > 1
    )
    return MergePlan(out, tuple(existing), unions, hashes)


def merge_runs(merge: MergePlan, tick: Callable[[], None] = lambda: None) -> MergeResult:
    """Write a planned merge and seal it; `tick` is called for every shard and every attempt.

    Called again, it completes an interrupted merge, and changes nothing in a complete one.
    """
    storage = open_storage(merge.out)
    runs: list[Run] = []
    for union in merge.unions:
        spec_hash = union.manifest.spec_hash
        target = storage if merge.is_ordinary else storage.below(part_folder(spec_hash))
        runs.append(begin_union(union, target))
    # From here on the result counts as merged runs; shards that are not written yet are missing.
    if not merge.is_ordinary:
        replace_record(storage, MERGED, encode_record(Merged(parts=merge.hashes)))
    written = [write_union(union, run, tick) for union, run in zip(merge.unions, runs, strict=True)]
    return MergeResult(storage, tuple(written), _seal(storage))


def _seal(storage: Storage) -> str:
    """Seal the result unless its store is up to date."""
    if not label_counts(open_runs(storage)).labels:
        return ""
    root = sealed_metadata(read_contents(storage, check=False))["zarr.json"]
    if storage.get(f"{SEALED}/zarr.json", 4 * MAX_RECORD_BYTES) == root:
        return f"{storage.url}/{SEALED}"
    return seal(storage)


def _existing_storage(out: str) -> Storage | None:
    """The storage of the result; None where the folder does not exist yet."""
    try:
        return open_storage(out, probe=False, create=False)
    except InputError as e:
        if e.problem == "no such folder":
            return None
        raise


def _identity(storage: Storage) -> str:
    return storage.url if storage.folder is None else str(storage.folder.resolve())


def _address(path: str) -> str:
    if path.startswith("s3://"):
        return path.rstrip("/")
    return str(Path(path.removeprefix("file://")).expanduser().resolve())


def _refuse_nested(paths: Sequence[str], out: str, existing: Sequence[Run], sources: Sequence[Run]) -> None:
    """Raise InputError where the result is inside a source or a source inside the result."""
    here, roots = _address(out), {_address(path) for path in paths}
    known = {here, *(_identity(run.storage) for run in existing)}
    for other in sorted({*roots, *(_identity(run.storage) for run in sources)} - known):
        if here.startswith(f"{other}/") or other.startswith(f"{here}/"):
            problem = f"is inside {other}" if here.startswith(other) else f"contains {other}"
            raise InputError(out, "--out", problem, "Choose another folder for the result")


def _refuse_unfit_output(existing: Sequence[Run], hashes: Sequence[str], layout: Layout) -> None:
    """Raise InputError for runs that cannot be added to the run at `out`, whose shards are kept."""
    if not existing:
        return
    first = existing[0]
    if first.layout != layout:
        raise InputError(
            first.storage.url,
            "layout.scenes_per_shard",
            f"is {first.layout.scenes_per_shard}, but these runs need {layout.scenes_per_shard}",
            _ELSEWHERE,
        )
    if len(existing) == 1 and len(hashes) > 1:
        other = next(h for h in hashes if h != first.manifest.spec_hash)
        raise InputError(
            first.storage.url,
            "spec_hash",
            f"is one run, and cannot hold runs of another specification ({other[:16]})",
            _ELSEWHERE,
        )
