"""Open runs and sealed stores for reading: shards and arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from datagen.schemas.errors import InputError, choices
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.shard_reading import ShardPlace, StoredArray, committed_place
from datagen.schemas.specification import Specification
from datagen.schemas.storage import open_storage
from datagen.train.sealed import is_sealed_store, open_sealed


@dataclass(frozen=True, eq=False)
class RunPart:
    """One run's shards and arrays, or those of a sealed store without its run.

    `spec_hashes` and `specs` have several where such a store was merged. `cost` adds up the commits' wall
    and CPU seconds, with those of the labels that a run was relabelled from; None where no commit came along.
    """

    place: str
    spec_hashes: tuple[str, ...]
    specs: tuple[Specification, ...]
    schema: str
    schema_version: int
    shards: Sequence[ShardPlace]
    arrays: Mapping[str, StoredArray]
    cost: Mapping[str, float] | None


def open_parts(
    places: Sequence[Path | str], names: Sequence[str], allow_incomplete: bool = False
) -> list[RunPart]:
    """The runs of all places, in order, with the named arrays, which are alike in all of them.

    InputError where a place is no run, of a schema that this program does not know, without such a field,
    or lacks samples that its plan has (without any, if `allow_incomplete`), and where two of them store a
    field differently.
    """
    if not places:
        raise InputError("training data", "", "no run is given", "Name at least one run folder")
    parts = [part for place in places for part in _open(place, names, allow_incomplete)]
    for part in parts[1:]:
        for name, ours in part.arrays.items():
            first = parts[0].arrays[name]
            if (ours.dtype, ours.dims, ours.shape[1:]) != (first.dtype, first.dims, first.shape[1:]):
                problem = f"{_words(ours)}, and {_words(first)} in {parts[0].place}"
                raise InputError(part.place, name, problem, "Read runs of equal parameters together")
    return parts


def refuse_twins(parts: Sequence[RunPart]) -> None:
    """InputError where two parts are of one specification: their samples would count twice."""
    seen: dict[str, str] = {}
    for part in parts:
        for spec_hash in part.spec_hashes:
            if spec_hash in seen:
                problem = f"has the specification of {seen[spec_hash]}, so samples would occur twice"
                raise InputError(part.place, "", problem, "Name it once, or merge them with `datagen merge`")
            seen[spec_hash] = part.place


def _words(array: StoredArray) -> str:
    return f"{array.dtype} {array.shape[1:]} a {array.dims[0]}"


def _open(place: Path | str, names: Sequence[str], allow_incomplete: bool) -> list[RunPart]:
    """The run, each of the merged ones, or the sealed store."""
    if is_sealed_store(place):
        sealed = open_sealed(place, names)
        return [
            RunPart(
                str(place),
                sealed.spec_hashes,
                sealed.specs,
                sealed.schema,
                sealed.schema_version,
                sealed.shards,
                sealed.arrays,
                None,
            )
        ]
    storage = open_storage(place, probe=False, create=False)
    found = (_open_run(run, names, allow_incomplete) for run in open_runs(storage))
    opened = [part for part in found if part is not None]
    if not opened:
        raise InputError(storage.url, "commits", "no shard is committed", "Make some with `datagen resume`")
    return opened


def _open_run(run: Run, names: Sequence[str], allow_incomplete: bool) -> RunPart | None:
    _ = run.schema  # refuses a version that this program does not know
    n, url = run.n, run.storage.url
    paths = {f"{name}/zarr.json" for name in names}
    shards: list[ShardPlace] = []
    arrays: dict[str, StoredArray] = {}
    first: dict[str, str] = {}
    cost = {"wall_s": 0.0, "cpu_s": 0.0}
    for commit in run.commits():
        if commit.shard >= run.layout.shards_for(n):
            continue
        place = committed_place(run.storage, commit, names, *run.layout.rows_wanted(commit.shard, n))
        metadata = {entry.path: entry.sha256 for entry in commit.files if entry.path in paths}
        if not shards:
            _refuse_unknown(url, names, commit)
            first, arrays = metadata, place.metadata(names)
        # Merged runs may come from programs that word an array's meaning otherwise.
        elif metadata != first:
            _refuse_other_arrays(place, arrays)
        shards.append(place)
        for kind in ("wall", "cpu"):
            cost[f"{kind}_s"] += commit.cost.all_s[kind]
    missing = n - sum(place.samples for place in shards)
    if missing and not allow_incomplete:
        problem = f"{missing:,} of the {n:,} planned samples are missing"
        fix = f"Make them with `datagen resume {url}`, or accept an incomplete run with --allow-incomplete"
        raise InputError(url, "commits", problem, fix)
    if not shards:
        return None
    manifest = run.manifest
    version = manifest.schema_version
    specs = (manifest.spec,)
    return RunPart(url, (manifest.spec_hash,), specs, manifest.schema_name, version, shards, arrays, cost)


def _refuse_unknown(url: str, names: Sequence[str], commit: Commit) -> None:
    stored = [e.path.removesuffix("/zarr.json") for e in commit.files if e.path.endswith("/zarr.json")]
    for name in names:
        if name not in stored:
            raise InputError(url, name, "is not a field of the run", choices(stored, name))


def _refuse_other_arrays(place: ShardPlace, arrays: Mapping[str, StoredArray]) -> None:
    for name, array in place.metadata(list(arrays)).items():
        if replace(array, attributes=arrays[name].attributes) != arrays[name]:
            raise InputError(
                f"{place.storage.url}/{place.folder}/{name}/zarr.json",
                name,
                "differs from the other shards' metadata",
                "Repair it with `datagen repair`",
            )
