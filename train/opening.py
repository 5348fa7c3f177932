"""Places opened for reading: which runs lie there, the shards that they have, and what their arrays are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from schemas.errors import InputError, choices
from schemas.keys import shard_folder
from schemas.merged import open_runs
from schemas.run import Run
from schemas.run_records import Commit
from schemas.shard_reading import ShardPlace, StoredArray, committed_place, read_metadata
from schemas.storage import open_storage
from train.sealed import is_sealed_store, open_sealed


@dataclass(frozen=True, eq=False)
class Part:
    """One run's shards and arrays, or those of a sealed store that came without its run.

    `spec_hashes` has several where such a store was merged. `cost` adds up the commits' wall and CPU
    seconds, with those of the labels that a run was relabelled from; None where no commit came along.
    """

    place: str
    spec_hashes: tuple[str, ...]
    schema: str
    schema_version: int
    shards: Sequence[ShardPlace]
    arrays: Mapping[str, StoredArray]
    cost: Mapping[str, float] | None


def open_parts(places: Sequence[Path | str], names: Sequence[str]) -> list[Part]:
    """The runs of all places, in order, with the named arrays, which are alike in all of them.

    InputError where a place is no run, of a schema that this program does not know, without shards or
    without such a field, and where two of them store a field differently.
    """
    if not places:
        raise InputError("training data", "", "no run is named", "Name at least one run's folder")
    parts = [part for place in places for part in _open(place, names)]
    for part in parts[1:]:
        for name, ours in part.arrays.items():
            first = parts[0].arrays[name]
            if (ours.dtype, ours.dims, ours.shape[1:]) != (first.dtype, first.dims, first.shape[1:]):
                problem = f"{_words(ours)}, and {_words(first)} in {parts[0].place}"
                raise InputError(part.place, name, problem, "Read runs of equal parameters together")
    return parts


def _words(array: StoredArray) -> str:
    return f"{array.dtype} {array.shape[1:]} a {array.dims[0]}"


def _open(place: Path | str, names: Sequence[str]) -> list[Part]:
    """The run, each of the merged ones, or the sealed store."""
    if is_sealed_store(place):
        sealed = open_sealed(place, names)
        return [
            Part(
                str(place),
                sealed.spec_hashes,
                sealed.schema,
                sealed.schema_version,
                sealed.shards,
                sealed.arrays,
                None,
            )
        ]
    storage = open_storage(place, probe=False, create=False)
    opened = [part for run in open_runs(storage) if (part := _open_run(run, names)) is not None]
    if not opened:
        raise InputError(storage.url, "commits", "no shard is committed", "Make some with `datagen resume`")
    return opened


def _open_run(run: Run, names: Sequence[str]) -> Part | None:
    _ = run.schema  # refuses a version that this program does not know
    n = run.n
    commits = [commit for commit in run.commits() if commit.shard < run.layout.shards_for(n)]
    if not commits:
        return None
    arrays = _arrays(run, commits, names)
    shards = [
        committed_place(run.storage, _folder(commit), commit, *run.layout.rows_wanted(commit.shard, n))
        for commit in commits
    ]
    cost = {
        "wall_s": sum(commit.cost.all_s["wall"] for commit in commits),
        "cpu_s": sum(commit.cost.all_s["cpu"] for commit in commits),
    }
    manifest = run.manifest
    version = manifest.schema_version
    return Part(run.storage.url, (manifest.spec_hash,), manifest.schema_name, version, shards, arrays, cost)


def _arrays(run: Run, commits: Sequence[Commit], names: Sequence[str]) -> dict[str, StoredArray]:
    """The named arrays as the first shard has them. InputError where another has them otherwise."""
    digests = [{entry.path: entry.sha256 for entry in commit.files} for commit in commits]
    paths = [f"{name}/zarr.json" for name in names]
    for name, path in zip(names, paths, strict=True):
        if path not in digests[0]:
            stored = [p.removesuffix("/zarr.json") for p in digests[0] if p.endswith("/zarr.json")]
            raise InputError(run.storage.url, name, "the run stores no such field", choices(stored))
    arrays = read_metadata(run.storage, _folder(commits[0]), names)
    for commit, digest in zip(commits, digests, strict=True):
        # Merged runs may come from programs that word an array's meaning otherwise.
        if any(digest.get(path) != digests[0][path] for path in paths):
            _refuse_other_arrays(run, _folder(commit), arrays)
    return arrays


def _folder(commit: Commit) -> str:
    return shard_folder(commit.shard, commit.attempt)


def _refuse_other_arrays(run: Run, folder: str, arrays: Mapping[str, StoredArray]) -> None:
    for name, array in read_metadata(run.storage, folder, arrays).items():
        if replace(array, attributes=arrays[name].attributes) != arrays[name]:
            raise InputError(
                f"{run.storage.url}/{folder}/{name}/zarr.json",
                name,
                "differs from the other shards' metadata",
                "Mend it with `datagen repair`",
            )
