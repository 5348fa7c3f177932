"""Read a sealed store without its run, as slices of shards, by its own attributes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError, choices
from datagen.schemas.fields import OLDEST_SCHEMA_VERSION, SCHEMAS
from datagen.schemas.keys import MERGED
from datagen.schemas.shard_reading import MAX_META_BYTES, ShardPlace, StoredArray
from datagen.schemas.specification import Specification
from datagen.schemas.storage import open_storage

_FIX = "Seal the run again, and copy the whole data.zarr"


@dataclass(frozen=True, eq=False)
class SealedStore:
    """What the store says of itself, its shards, and the arrays that were asked for."""

    spec_hashes: tuple[str, ...]  # of the runs that it holds
    specs: tuple[Specification, ...]
    schema: str
    schema_version: int
    shards: Sequence[ShardPlace]
    arrays: Mapping[str, StoredArray]


def is_sealed_store(place: Path | str) -> bool:
    """Whether the place is named like a sealed store (`....zarr`) and is not a run of such a name."""
    if not str(place).rstrip("/").endswith(".zarr"):
        return False
    storage = open_storage(place, probe=False, create=False)
    return not storage.exists("manifest.json") and not storage.exists(MERGED)


def open_sealed(place: Path | str, names: Sequence[str]) -> SealedStore:
    """The store with the named arrays.

    InputError when it is not a sealed store, of a schema that this program does not know, or lacks a field.
    """
    storage = open_storage(place, probe=False, create=False)
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
        told = attributes.get("parts", [attributes])
        spec_hashes = tuple(str(part["spec_hash"]) for part in told)
        specs = tuple(Specification.model_validate_json(json.dumps(part["specification"])) for part in told)
    except (ValueError, KeyError, TypeError, RecursionError) as e:
        raise InputError(where, "", f"is not the root of a sealed store ({e})", _FIX) from e
    if schema not in SCHEMAS or not OLDEST_SCHEMA_VERSION <= version <= SCHEMAS[schema].version:
        known = ", ".join(f"{s.name} {OLDEST_SCHEMA_VERSION} to {s.version}" for s in SCHEMAS.values())
        problem = f"is {schema!r} {version}, but this program reads {known}"
        raise InputError(where, "schema_version", problem, "Use the version of datagen that made the run")
    for name in names:
        if name not in stored:
            raise InputError(storage.url, name, "is not a field of the store", choices(stored, name))
    arrays = ShardPlace(storage, "", 0, 0, 0, 0, 0).metadata(names)
    scenes = {a.shape[0] for a in arrays.values() if a.dims[0] == "scene"}
    samples = {a.shape[0] for a in arrays.values() if a.dims[0] == "sample"}
    if len(scenes) != 1 or len(samples) != 1 or per_shard < 1 or per_scene < 1:
        raise InputError(where, "shape", "differs between arrays of one table", _FIX)
    n_scenes, n_samples = scenes.pop(), samples.pop()
    full = per_shard * per_scene
    if (shards := -(-n_scenes // per_shard)) != -(-n_samples // full):
        raise InputError(where, "shape", f"{n_scenes} scenes do not match {n_samples} samples", _FIX)
    for array in arrays.values():
        if (per_shard if array.dims[0] == "scene" else full) % array.chunk_rows:
            raise InputError(where, array.name, "chunks that do not divide a shard", _FIX)
    slices = [
        ShardPlace(
            storage,
            "",
            i,
            min(per_shard, n_scenes - i * per_shard),
            min(full, n_samples - i * full),
            per_shard,
            full,
        )
        for i in range(shards)
    ]
    return SealedStore(spec_hashes, specs, schema, version, slices, arrays)
