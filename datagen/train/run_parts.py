"""Open runs and sealed stores for reading: shards and arrays."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError, choices
from datagen.schemas.fields import OLDEST_SCHEMA, SCHEMA_VERSION, SCHEMAS
from datagen.schemas.record_files import MERGED
from datagen.schemas.run import Rows, Run, open_runs
from datagen.schemas.run_records import MAX_FILE_BYTES, Layout
from datagen.schemas.sealing import ZIPPED
from datagen.schemas.shard_reading import ShardPlace, StoreFiles, ZipFiles, ZipSource, committed_place
from datagen.schemas.specification import Specification
from datagen.schemas.storage import open_storage
from datagen.schemas.stored_arrays import MAX_META_BYTES, StoredArray, arrays_of, readable, sources_of
from datagen.workers.motion.pose_reach import known_arm
from datagen.workers.robots import remember

# Fields that join the two tables; every reader needs them.
JOIN_FIELDS = ("scene_index", "sample_scene_index")
_SEALED_FIX = "Seal the run again, and copy the whole data.zarr"


@dataclass(frozen=True, eq=False)
class RunPart:
    """One run's shards and arrays, or those of a sealed store without its run.

    A merged store has several `spec_hashes`, `specs` and `sources`, those of their manifests. A sealed store
    has empty `sources`, and its root's `attributes`. `cost` is the sum over commits of wall and CPU seconds,
    with those of the labels that a run was relabelled from; None for a sealed store. `merged` is the address
    of the merged runs that it is a part of: their parts have no scene in common.
    """

    place: str
    spec_hashes: tuple[str, ...]
    specs: tuple[Specification, ...]
    schema: str
    schema_version: int
    shards: Sequence[ShardPlace]
    arrays: Mapping[str, StoredArray]
    cost: Mapping[str, float] | None
    sources: tuple[Mapping[str, str], ...]
    attributes: Mapping[str, Any]
    merged: str = ""

    @property
    def robot(self) -> str:
        """The robot of its labels as `open_robot` accepts it; "" where labels know no robot."""
        arm = self.specs[0].arm if self.specs else None  # merged runs have one
        return "" if arm is None else arm.robot_key


def read_robots(parts: Iterable[RunPart]) -> None:
    """Read the files of robots that runs were made with, unless they are known without.

    InputError where one is missing or has changed.
    """
    for part in parts:
        arm = part.specs[0].arm if part.specs else None
        if arm is not None and arm.robot_digest is not None and not known_arm(arm.robot_key):
            place = part.sources[0].get("robot") if part.sources else None
            remember(place or arm.robot, arm.robot, arm.robot_digest)


def open_parts(
    paths: Sequence[Path | str],
    names: Sequence[str],
    allow_incomplete: bool = False,
    uneven: Sequence[str] = (),
) -> list[RunPart]:
    """The runs at all paths, in order, with the named arrays, which have equal types in all of them.

    Rows of `uneven` ones may have other lengths: scenes of some runs have more clutter. InputError for a path
    without a run, an unknown schema, a missing field, or missing samples of the plan (unless
    `allow_incomplete`).
    """
    if not paths:
        raise InputError("training data", "", "no run is given", "Name at least one run folder")
    parts = [part for path in paths for part in _open(path, names, allow_incomplete)]
    for part in parts[1:]:
        for name, ours in part.arrays.items():
            first = parts[0].arrays[name]
            same_rows = name in uneven or ours.shape[1:] == first.shape[1:]
            if (ours.dtype, ours.dims) != (first.dtype, first.dims) or not same_rows:
                problem = f"{_words(ours)}, and {_words(first)} in {parts[0].place}"
                raise InputError(part.place, name, problem, "Read runs of equal parameters together")
    return parts


def refuse_twins(parts: Sequence[RunPart]) -> None:
    """Raise InputError where two parts have one specification: their samples would count twice."""
    seen: dict[str, RunPart] = {}
    for part in parts:
        for spec_hash in part.spec_hashes:
            first = seen.setdefault(spec_hash, part)
            if first is not part and not (part.merged and part.merged == first.merged):
                problem = f"has the specification of {first.place}, so samples would occur twice"
                raise InputError(part.place, "", problem, "Name it once, or merge them with `datagen merge`")


def _words(array: StoredArray) -> str:
    return f"{array.dtype} {array.shape[1:]} a {array.dims[0]}"


def _open(path: Path | str, names: Sequence[str], allow_incomplete: bool) -> list[RunPart]:
    if is_sealed_store(path):
        return [open_sealed(path, names)]
    storage = open_storage(path, probe=False, create=False)
    runs = open_runs(storage)
    merged = storage.url if len(runs) > 1 else ""
    found = (_open_run(run, merged, names, allow_incomplete) for run in runs)
    opened = [part for part in found if part is not None]
    if not opened:
        raise InputError(storage.url, "commits", "no shard is committed", "Make some with `datagen resume`")
    return opened


def _open_run(run: Run, merged: str, names: Sequence[str], allow_incomplete: bool) -> RunPart | None:
    n, url = run.n, run.storage.url
    stored = arrays_of(run.schema, run.layout)
    _refuse_unknown(url, sources_of(names, stored), list(stored))
    planned, shards = run.planned(n), list[ShardPlace]()
    cost = {"wall_s": 0.0, "cpu_s": 0.0}
    for commit in run.commits():
        if commit.shard in planned:
            shards.append(committed_place(run, commit, run.rows_of(commit.shard, n)))
            for kind in ("wall", "cpu"):
                cost[f"{kind}_s"] += commit.cost.all_s[kind]
    wanted = run.samples_wanted(n)
    missing = wanted - sum(place.samples for place in shards)
    if missing and not allow_incomplete:
        problem = f"{missing:,} of the {wanted:,} planned samples are missing"
        fix = f"Make them: {run.command_for_missing}; or allow an incomplete run where that is an option"
        raise InputError(url, "commits", problem, fix)
    if not shards:
        return None
    manifest = run.manifest
    version = manifest.schema_version
    specs, arrays = (manifest.spec,), readable(names, stored)
    hashes, schema, sources = (manifest.spec_hash,), manifest.schema_name, (manifest.sources,)
    return RunPart(url, hashes, specs, schema, version, shards, arrays, cost, sources, {}, merged)


def _refuse_unknown(url: str, names: Sequence[str], stored: Sequence[str]) -> None:
    for name in names:
        if name not in stored:
            raise InputError(url, name, "is not a field of the run", choices(stored, name))


def is_sealed_store(path: Path | str) -> bool:
    """Whether the path ends like a zipped store's, or like a sealed store's (`.zarr`) and holds no run."""
    if str(path).endswith(ZIPPED):
        return True
    if not str(path).rstrip("/").endswith(".zarr"):
        return False
    storage = open_storage(path, probe=False, create=False)
    return not storage.exists("manifest.json") and not storage.exists(MERGED)


def open_sealed(path: Path | str, names: Sequence[str]) -> RunPart:
    """A sealed store without its run, with the named arrays, described by its own attributes."""
    source, data = _sealed_files(str(path))
    where = f"{source.url}/zarr.json"
    try:
        meta: dict[str, Any] = json.loads(data)
        attributes = meta["attributes"]
        per_shard, per_scene = attributes["scenes_per_shard"], attributes["candidates_per_scene"]
        layout = Layout(scenes_per_shard=per_shard, candidates_per_scene=per_scene)
        stored = list(meta["consolidated_metadata"]["metadata"])
        schema, version = str(attributes["schema"]), int(attributes["schema_version"])
        runs = attributes["parts"]
        spec_hashes = tuple(dict.fromkeys(str(part["spec_hash"]) for part in runs))
        specs = tuple(Specification.model_validate_json(json.dumps(part["specification"])) for part in runs)
    except (ValueError, KeyError, TypeError, RecursionError) as e:
        raise InputError(where, "", f"is not the root of a sealed store ({e})", _SEALED_FIX) from e
    if schema not in SCHEMAS or not OLDEST_SCHEMA <= version <= SCHEMA_VERSION:
        readable_here = f"{', '.join(SCHEMAS)} {OLDEST_SCHEMA} to {SCHEMA_VERSION}"
        problem = f"is {schema!r} {version}, but this program reads {readable_here}"
        raise InputError(where, "schema_version", problem, "Use the version of datagen that made the run")
    needed = sources_of(names, stored)
    _refuse_unknown(source.url, needed, stored)
    arrays = readable(names, source.metadata(needed))
    scenes = {a.shape[0] for a in arrays.values() if a.dims[0] == "scene"}
    samples = {a.shape[0] for a in arrays.values() if a.dims[0] == "sample"}
    if len(scenes) != 1 or len(samples) != 1:
        raise InputError(where, "shape", "differs between arrays of one table", _SEALED_FIX)
    n_scenes, n_samples = scenes.pop(), samples.pop()
    if n_scenes != -(-n_samples // per_scene):
        raise InputError(where, "shape", f"{n_scenes} scenes do not match {n_samples} samples", _SEALED_FIX)
    for array in arrays.values():
        if (per_shard if array.dims[0] == "scene" else layout.samples_per_shard) % array.chunk_rows:
            raise InputError(where, array.name, "chunks that do not divide a shard", _SEALED_FIX)
    slices = [
        ShardPlace(source, k, Rows(0, *layout.rows_wanted(k, n_samples)), per_shard, layout.samples_per_shard)
        for k in range(layout.shards_for(n_samples))
    ]
    sources = tuple({} for _ in specs)
    return RunPart(str(path), spec_hashes, specs, schema, version, slices, arrays, None, sources, attributes)


def _sealed_files(path: str) -> tuple[StoreFiles | ZipSource, bytes]:
    """The source of a sealed store, and its root's zarr.json. InputError where it is missing."""
    is_zip = path.endswith(ZIPPED)
    folder, _, name = path.rpartition("/") if is_zip else (path, "", "zarr.json")
    storage = open_storage(folder or ".", probe=False, create=False)
    data = storage.get(name, MAX_FILE_BYTES if is_zip else 64 * MAX_META_BYTES)
    if data is None:
        fix = "Name a run's folder or a sealed data.zarr"
        raise InputError(f"{storage.url}/{name}", "", "no such file", fix)
    if not is_zip:
        return StoreFiles(storage), data
    files = ZipFiles(f"{storage.url}/{name}", data)
    return ZipSource(files.place, lambda: files), files.get("zarr.json")


def specs_of(path: Path | str) -> tuple[Specification, ...]:
    """The specifications of the run, the merged runs or the sealed store at a path."""
    if is_sealed_store(path):
        return open_sealed(path, JOIN_FIELDS).specs
    return tuple(run.manifest.spec for run in open_runs(path))


def refuse_mixed_labels(parts: Sequence[tuple[str, Specification]]) -> None:
    """Raise InputError where runs, (path, specification), have labels of one source in two versions."""
    seen: dict[str, tuple[str, str]] = {}
    for place, spec in parts:
        version = spec.engines.get("labels", "unknown")
        first, at = seen.setdefault(spec.label_source, (version, place))
        if first != version:
            problem = f"{spec.label_source} labels are of version {version}, those of {at} of version {first}"
            raise InputError(place, "label_version", problem, "Use runs of one version")
