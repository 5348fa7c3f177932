"""Open runs and sealed stores for reading: shards and arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError, choices
from datagen.schemas.fields import SCHEMA_VERSION, SCHEMAS
from datagen.schemas.record_files import MERGED
from datagen.schemas.run import Run, open_runs
from datagen.schemas.shard_reading import MAX_META_BYTES, ShardPlace, StoredArray, committed_place
from datagen.schemas.specification import Specification
from datagen.schemas.storage import open_storage

_SEALED_FIX = "Seal the run again, and copy the whole data.zarr"


@dataclass(frozen=True, eq=False)
class RunPart:
    """One run's shards and arrays, or those of a sealed store without its run.

    A merged store has several `spec_hashes` and `specs`. `cost` is the sum over commits of wall and CPU
    seconds, with those of the labels that a run was relabelled from; None for a sealed store.
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
    paths: Sequence[Path | str], names: Sequence[str], allow_incomplete: bool = False
) -> list[RunPart]:
    """The runs at all paths, in order, with the named arrays, which have equal types in all of them.

    InputError for a path without a run, an unknown schema, a missing field, or missing samples of the plan
    (unless `allow_incomplete`).
    """
    if not paths:
        raise InputError("training data", "", "no run is given", "Name at least one run folder")
    parts = [part for path in paths for part in _open(path, names, allow_incomplete)]
    for part in parts[1:]:
        for name, ours in part.arrays.items():
            first = parts[0].arrays[name]
            if (ours.dtype, ours.dims, ours.shape[1:]) != (first.dtype, first.dims, first.shape[1:]):
                problem = f"{_words(ours)}, and {_words(first)} in {parts[0].place}"
                raise InputError(part.place, name, problem, "Read runs of equal parameters together")
    return parts


def refuse_twins(parts: Sequence[RunPart]) -> None:
    """Raise InputError where two parts have one specification: their samples would count twice."""
    seen: dict[str, str] = {}
    for part in parts:
        for spec_hash in part.spec_hashes:
            if spec_hash in seen:
                problem = f"has the specification of {seen[spec_hash]}, so samples would occur twice"
                raise InputError(part.place, "", problem, "Name it once, or merge them with `datagen merge`")
            seen[spec_hash] = part.place


def _words(array: StoredArray) -> str:
    return f"{array.dtype} {array.shape[1:]} a {array.dims[0]}"


def _open(path: Path | str, names: Sequence[str], allow_incomplete: bool) -> list[RunPart]:
    """The parts of a run, of merged runs, or of a sealed store."""
    if is_sealed_store(path):
        return [open_sealed(path, names)]
    storage = open_storage(path, probe=False, create=False)
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
            stored = [e.path for e in commit.files if e.path.endswith("/zarr.json")]
            _refuse_unknown(url, names, [path.removesuffix("/zarr.json") for path in stored])
            first, arrays = metadata, place.metadata(names)
        # Merged runs may come from versions that describe an array in other words.
        elif metadata != first:
            _refuse_other_arrays(place, arrays)
        shards.append(place)
        for kind in ("wall", "cpu"):
            cost[f"{kind}_s"] += commit.cost.all_s[kind]
    missing = n - sum(place.samples for place in shards)
    if missing and not allow_incomplete:
        problem = f"{missing:,} of the {n:,} planned samples are missing"
        fix = f"Make them with `datagen resume {url}`, or allow an incomplete run where that is an option"
        raise InputError(url, "commits", problem, fix)
    if not shards:
        return None
    manifest = run.manifest
    version = manifest.schema_version
    specs = (manifest.spec,)
    return RunPart(url, (manifest.spec_hash,), specs, manifest.schema_name, version, shards, arrays, cost)


def _refuse_unknown(url: str, names: Sequence[str], stored: Sequence[str]) -> None:
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
                "Repair it with `datagen verify --repair`",
            )


def is_sealed_store(path: Path | str) -> bool:
    """Whether the path ends like that of a sealed store (`.zarr`) and holds no run."""
    if not str(path).rstrip("/").endswith(".zarr"):
        return False
    storage = open_storage(path, probe=False, create=False)
    return not storage.exists("manifest.json") and not storage.exists(MERGED)


def open_sealed(path: Path | str, names: Sequence[str]) -> RunPart:
    """A sealed store without its run, with the named arrays, described by its own attributes."""
    storage = open_storage(path, probe=False, create=False)
    data = storage.get("zarr.json", 64 * MAX_META_BYTES)
    where = f"{storage.url}/zarr.json"
    if data is None:
        raise InputError(where, "", "no such file", "Name a run's folder or a sealed data.zarr")
    try:
        meta: dict[str, Any] = json.loads(data)
        attributes = meta["attributes"]
        per_shard = int(attributes["scenes_per_shard"])
        per_scene = int(attributes["candidates_per_scene"])
        stored = list(meta["consolidated_metadata"]["metadata"])
        schema, version = str(attributes["schema"]), int(attributes["schema_version"])
        runs = attributes.get("parts", [attributes])
        spec_hashes = tuple(str(part["spec_hash"]) for part in runs)
        specs = tuple(Specification.model_validate_json(json.dumps(part["specification"])) for part in runs)
    except (ValueError, KeyError, TypeError, RecursionError) as e:
        raise InputError(where, "", f"is not the root of a sealed store ({e})", _SEALED_FIX) from e
    if schema not in SCHEMAS or version != SCHEMA_VERSION:
        problem = f"is {schema!r} {version}, but this program reads {', '.join(SCHEMAS)} {SCHEMA_VERSION}"
        raise InputError(where, "schema_version", problem, "Use the version of datagen that made the run")
    _refuse_unknown(storage.url, names, stored)
    arrays = ShardPlace(storage, "", 0, 0, 0, 0, 0).metadata(names)
    scenes = {a.shape[0] for a in arrays.values() if a.dims[0] == "scene"}
    samples = {a.shape[0] for a in arrays.values() if a.dims[0] == "sample"}
    if len(scenes) != 1 or len(samples) != 1 or per_shard < 1 or per_scene < 1:
        raise InputError(where, "shape", "differs between arrays of one table", _SEALED_FIX)
    n_scenes, n_samples = scenes.pop(), samples.pop()
    full = per_shard * per_scene
    if (shards := -(-n_scenes // per_shard)) != -(-n_samples // full):
        raise InputError(where, "shape", f"{n_scenes} scenes do not match {n_samples} samples", _SEALED_FIX)
    for array in arrays.values():
        if (per_shard if array.dims[0] == "scene" else full) % array.chunk_rows:
            raise InputError(where, array.name, "chunks that do not divide a shard", _SEALED_FIX)
    counts = [
        (min(per_shard, n_scenes - i * per_shard), min(full, n_samples - i * full)) for i in range(shards)
    ]
    slices = [ShardPlace(storage, "", i, *count, per_shard, full) for i, count in enumerate(counts)]
    return RunPart(str(path), spec_hashes, specs, schema, version, slices, arrays, None)


def refuse_mixed_labels(parts: Sequence[tuple[str, Specification]]) -> None:
    """Raise InputError where runs, (path, specification), have labels of one source in two versions."""
    seen: dict[str, tuple[str, str]] = {}
    for place, spec in parts:
        version = spec.engines.get("labels", "unknown")
        first, at = seen.setdefault(spec.label_source, (version, place))
        if first != version:
            problem = f"{spec.label_source} labels are of version {version}, those of {at} of version {first}"
            raise InputError(place, "label_version", problem, "Use runs of one version")
