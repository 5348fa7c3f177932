"""Runs filled with random rows that follow the schema: the store cares for bytes, not for meaning."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.fields import REDRAW_CAUSES, Field, RecordSchema, sized_schema
from datagen.schemas.identity import sample_ids
from datagen.schemas.record_files import commit_key, encode_record, object_key, utc_now
from datagen.schemas.run import Run
from datagen.schemas.run_records import (
    Commit,
    Cost,
    FileEntry,
    Host,
    Layout,
    LedgerEntry,
    Manifest,
    QuarantineRecord,
)
from datagen.schemas.shard_files import encode_shard, zipped
from datagen.schemas.shard_reading import ZipFiles
from datagen.schemas.specification import ObservationParams, SceneParams, Source, Specification
from datagen.schemas.storage import open_storage

Tables = tuple[dict[str, np.ndarray[Any, Any]], dict[str, np.ndarray[Any, Any]]]


def small_spec(seed: int = 0, n_points: int = 64, **changes: Any) -> Specification:
    return Specification(
        seed=seed,
        houses=Source(kind="builtin", digest="1" * 64),
        objects=Source(kind="builtin", digest="2" * 64),
        scene=SceneParams(n_clutter=2),
        observation=ObservationParams(n_points=n_points),
        **changes,
    )


def manifest_of(spec: Specification, layout: Layout) -> Manifest:
    schema = sized_schema("heuristic", spec)
    return Manifest(
        spec=spec,
        spec_hash=spec.hash(),
        schema_name=schema.name,
        schema_version=schema.version,
        layout=layout,
        code_version="0",
        code_digest="0" * 64,
        libraries={},
        platform="test",
        created=utc_now(),
    )


def make_run(
    folder: Path | str,
    n: int = 50,
    scenes_per_shard: int = 2,
    candidates_per_scene: int = 5,
    shards: Iterable[int] | None = None,
    spec: Specification | None = None,
    sources: dict[str, str] | None = None,
) -> Run:
    """A run of n samples with the given shards committed in the given order (default: all)."""
    layout = Layout(scenes_per_shard=scenes_per_shard, candidates_per_scene=candidates_per_scene)
    manifest = manifest_of(spec or small_spec(), layout).model_copy(update={"sources": sources or {}})
    run = Run.create_or_open(open_storage(folder), manifest, n)
    for shard in run.missing() if shards is None else shards:
        assert attempt(run, shard, f"a-{shard}")
    return run


def attempt(run: Run, shard: int, name: str) -> bool:
    """One whole attempt at a shard with its account in the ledger; whether it won."""
    run.ledger.start(name, shard)
    commit = write(run, shard, name)
    won = run.commit(commit)
    if not won:
        entry = LedgerEntry(attempt=name, shard=shard, outcome="superseded", ended=utc_now())
        run.ledger.end(entry.model_copy(update={"cost": commit.cost, "host": commit.host}))
    return won


def write(run: Run, shard: int, attempt: str) -> Commit:
    """Write a shard of random rows; its commit record, not yet published."""
    scenes, samples = rows_of(run, shard)
    data = encode_shard(run.schema, run.layout, run.manifest.spec_hash, scenes, samples)
    sums = dict(zip(REDRAW_CAUSES, scenes["redraws"].sum(axis=0).tolist(), strict=True))
    redraws = {cause: count for cause, count in sums.items() if count}
    entry = run.write_object(attempt, data)
    return commit_of(run, shard, attempt, entry, int(samples["label"].sum()), redraws)


def commit_of(
    run: Run,
    shard: int,
    attempt: str,
    entry: FileEntry,
    positives: int = 0,
    redraws: Mapping[str, int] | None = None,
) -> Commit:
    return Commit(
        shard=shard,
        attempt=attempt,
        spec_hash=run.manifest.spec_hash,
        scenes=run.layout.scenes_per_shard,
        samples=run.layout.samples_per_shard,
        positives=positives,
        redraws=dict(redraws or {}),
        object=entry,
        cost=Cost(wall_s=1.0, cpu_s=1.0),
        host=Host(name="h", cpu="c", cores=1, memory_bytes=1),
        code_digest="0" * 64,
        created=utc_now(),
    )


def with_files(data: bytes, changed: Mapping[str, bytes]) -> bytes:
    """A shard's object with other or further files."""
    files = ZipFiles("object", data)
    return zipped({path: files.get(path) for path in files.paths} | dict(changed))


def resign(run: Run, attempt: str, changed: Mapping[str, bytes]) -> None:
    """Change files in the object of a committed attempt, and its commit as if they were its own."""
    commit = next(commit for commit in run.commits() if commit.attempt == attempt)
    data = with_files(run.read_object(commit), changed)
    run.storage.put(object_key(attempt), data)
    signed = commit.model_copy(update={"object": FileEntry.of(f"{attempt}.zip", data)})
    run.storage.put(commit_key(commit.shard), encode_record(signed))


def object_of(folder: Path, shard: int) -> Path:
    """The file of a committed shard's rows."""
    return folder / object_key(Run.open(folder).commit_of(shard).attempt)


def flip(file: Path) -> None:
    """Change one bit in the middle of a file."""
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))


def rows_of(run: Run, shard: int) -> Tables:
    """The rows that `write` gives this shard."""
    return tables_of(run.schema, run.layout, run.manifest.spec.seed, shard, run.manifest.spec_hash)


def tables_of(
    schema: RecordSchema, layout: Layout, seed: int, shard: int, spec_hash: str = "0" * 64
) -> Tables:
    """The rows of one shard. A scene's rows depend on seed and scene alone, as in a real run."""
    first = shard * layout.scenes_per_shard
    each = [
        _scene(schema, layout.candidates_per_scene, seed, scene, spec_hash)
        for scene in range(first, first + layout.scenes_per_shard)
    ]
    scenes, samples = (
        {name: np.concatenate([e[t][name] for e in each]) for name in each[0][t]} for t in (0, 1)
    )
    return scenes, samples


def _scene(schema: RecordSchema, candidates: int, seed: int, scene: int, spec_hash: str) -> Tables:
    rng = np.random.default_rng([seed, scene])
    scenes = {f.name: values_of(schema, f, 1, rng) for f in schema.scene_fields}
    samples = {f.name: values_of(schema, f, candidates, rng) for f in schema.sample_fields}
    scenes["scene_index"][:] = scene
    samples["sample_scene_index"][:] = scene
    samples["candidate_index"][:] = np.arange(candidates)
    samples["sample_id"][:] = sample_ids(spec_hash, scene, np.arange(candidates))
    return scenes, samples


def values_of(schema: RecordSchema, f: Field, rows: int, rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """Random values within the field's range."""
    shape = schema.shape(f, rows)
    if f.is_text:
        words = np.array(["", "table", "Küche", "椅子", "x" * 40], object)
        return rng.choice(words, shape)
    dtype = np.dtype(f.dtype)
    low, high = f.low if f.low is not None else 0, f.high if f.high is not None else 100
    if dtype.kind == "f":
        return rng.uniform(low, high, shape).astype(dtype)
    if dtype.kind == "b":
        return rng.integers(0, 2, shape).astype(bool)
    return rng.integers(int(low), int(min(high, np.iinfo(dtype).max, 10**6)) + 1, shape).astype(dtype)


def lose(run: Path, *shards: int) -> None:
    """As if these shards had never been made."""
    for shard in shards:
        object_of(run, shard).unlink()
        (run / f"commits/{shard:06d}.json").unlink()
        for file in run.glob(f"ledger/{shard:06d}-*"):
            file.unlink()


def give_up(
    run: Run, shard: int, *causes: str, attempts: tuple[str, ...] = ("a",), stack: str = "", at: str = ""
) -> None:
    """Put a shard into quarantine for these causes of its attempts, the first with a stack."""
    scenes = run.layout.scenes_per_shard
    record = QuarantineRecord(
        shard=shard, seed=0, first_scene=shard * scenes, scenes=scenes, attempts=attempts, causes=causes,
        stacks=(stack, *("" for _ in causes[1:])), created=at or utc_now(),
    )  # fmt: skip
    assert run.quarantine(record)


def attempts_of(run: Run) -> set[str]:
    """The attempts of a run's ledger."""
    return {file.key.split("/")[1].split(".")[0] for file in run.storage.list("ledger")}


def files_of(folder: Path, *below: str) -> dict[str, bytes]:
    """Every file of a folder, or of some of the folders in it, by relative path."""
    roots = [folder / name for name in below] or [folder]
    files = [p for root in roots for p in sorted(root.rglob("*")) if p.is_file()]
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}
