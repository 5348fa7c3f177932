"""Make stored scenes again from specification and assets, and compare them bit for bit."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError
from typing import Any

import numpy as np

from datagen.cluster.attempt_guard import this_host
from datagen.console.options import AS_FOUND, AssetSources, Sources
from datagen.schemas.checking.finding import Finding
from datagen.schemas.errors import InputError
from datagen.schemas.fields import Field
from datagen.schemas.record_files import object_key
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scenes
from datagen.schemas.storage.errors import StoreUnavailable
from datagen.workers.engine_versions import label_engines, scene_engines
from datagen.workers.run_shard import run_shard
from datagen.workers.world import World, open_world

Array = np.ndarray[Any, Any]


def open_sources(run: Run, given: Sources = AS_FOUND) -> tuple[World, Run | None]:
    """Open the houses, objects and robot of a run, and the run whose scenes it labelled, or None.

    They are those given, else those in its manifest. InputError where they do not exist, or differ from those
    that the run was made from.
    """
    spec = run.manifest.spec
    world = open_world(spec, *places_of(run, given))
    return world, source_of(run, given) if spec.scenes_from is not None else None


def places_of(run: Run, given: AssetSources = AS_FOUND) -> tuple[str, str, str]:
    """Where houses, objects and the robot's file of a run are: as given, else as in its manifest."""
    known = run.manifest.sources
    houses, objects = (known.get(name, "builtin") for name in ("houses", "objects"))
    return given.houses or houses, given.objects or objects, given.robot or known.get("robot", "")


def source_of(run: Run, given: Sources = AS_FOUND) -> Run:
    """The run whose scenes this one labelled. InputError where it is missing or has other scenes."""
    path = given.scenes_from or run.manifest.sources.get("scenes_from", "")
    fix = "Give --scenes-from with the run that this one was started with"
    if not path:
        raise InputError(run.storage.url, "scenes_from", "is not in the run's manifest", fix)
    try:
        source = Run.open(path)
    except InputError as error:
        if given.scenes_from is not None or isinstance(error, StoreUnavailable):
            raise
        problem = f"names {error.place} for the scenes, which cannot be opened ({error.problem})"
        raise InputError(f"{run.storage.url}/manifest.json", "scenes_from", problem, fix) from error
    stored = run.manifest.spec.scenes_from
    if stored is None or source.manifest.spec.scenes_hash != stored.spec_hash:
        raise InputError(path, "spec_hash", "has other scenes than this run", fix)
    return source


def replay_findings(
    runs: Sequence[Run], count: int, given: Sources = AS_FOUND, seen: Callable[[int, int], None] | None = None
) -> Iterator[tuple[Run, Finding]]:
    """Make `count` committed scenes again, evenly spaced over the runs, and yield where they differ.

    Keys of the findings are relative to the run's address. A run that labelled the scenes of another one is
    compared with that run's scenes, or with its own where that run does not exist any more: they are labelled
    again from the stored poses. InputError where houses or objects are missing or differ.
    """
    shards = [(run, shard) for run in runs for shard in sorted(run.committed())]
    scenes = [run.layout.scenes_per_shard for run, _ in shards]
    ends = np.cumsum(scenes)
    total = int(ends[-1]) if shards else 0
    chosen = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(np.int64))
    worlds: dict[str, tuple[World, Run]] = {}
    for done, position in enumerate(chosen.tolist()):
        k = int(np.searchsorted(ends, position, side="right"))
        run, shard = shards[k]
        if run.storage.url not in worlds:
            worlds = {run.storage.url: _opened(run, given)}  # a world is large
        world, source = worlds[run.storage.url]
        scene = shard * scenes[k] + position - int(ends[k]) + scenes[k]
        yield from ((run, finding) for finding in _replay(run, scene, world, source))
        if seen is not None:
            seen(done + 1, len(chosen))


def _opened(run: Run, given: Sources) -> tuple[World, Run]:
    """The world of a run, and the run with the scenes that it labels: by default itself."""
    try:
        world, source = open_sources(run, given)
    except InputError:
        if run.manifest.spec.scenes_from is None or given.scenes_from is not None:
            raise
        return open_world(run.manifest.spec, *places_of(run, given)), run
    return world, source or run


def _replay(run: Run, scene: int, world: World, source: Run) -> Iterator[Finding]:
    shard = scene // run.layout.scenes_per_shard
    try:
        stored = next(read_scenes(run, [scene]))
        labelled = None if run.manifest.spec.scenes_from is None else read_scenes(source, [scene])
        made = run_shard(run.manifest.spec, world, [scene], labelled)
    except InputError as error:
        problem = f"scene {scene} cannot be made again: {error.problem}"
        yield Finding(
            str(error.place).removeprefix(f"{run.storage.url}/"), "replay", problem, error.fix, shard
        )
        return
    differences = [
        text
        for field in run.schema.scene_fields
        if (text := _difference(field, np.asarray(stored.record[field.name])[None], made.scene[field.name]))
    ] + [
        text
        for field in run.schema.sample_fields
        if (text := _difference(field, stored.samples[field.name], made.sample[field.name]))
    ]
    if differences:
        here = "; ".join(differs_here(run, shard))
        fix = "Do not use this run; find the cause in its code version, libraries or machine"
        if here:
            fix = (
                f"Replay it where it was made, or with a tolerance of your own: this machine differs ({here})"
            )
        key = object_key(run.commit_of(shard).attempt)
        yield Finding(key, "replay", f"scene {scene}: {'; '.join(differences)}", fix, shard)


def _difference(field: Field, stored: Array, made: Array) -> str:
    """In how many values two arrays differ bit for bit, and the largest difference; "" where in none."""
    if stored.shape != made.shape:
        return f"{field.name}: shape {made.shape}, stored {stored.shape}"
    if field.is_text:
        count = int((stored.astype(object) != made.astype(object)).sum())
        return f"{field.name}: {count} differ" if count else ""
    count = int((_bits(stored, field) != _bits(made, field)).sum())
    if not count:
        return ""
    with np.errstate(invalid="ignore", over="ignore"):
        gaps = np.abs(stored.astype(np.float64) - made.astype(np.float64))
    finite = gaps[np.isfinite(gaps)]
    unit = "" if field.unit == "1" else f" {field.unit}"
    by = f", by up to {finite.max():.3g}{unit}" if finite.size and field.name != "sample_id" else ""
    return f"{field.name}: {count} differ{by}"


def _bits(values: Array, field: Field) -> Array:
    """The values' bytes as integers, so that 0 differs from -0 and NaN equals itself."""
    plain = np.ascontiguousarray(values, np.dtype(field.dtype).newbyteorder("="))
    return plain.view(f"u{plain.dtype.itemsize}").reshape(values.shape)


def differs_here(run: Run, shard: int) -> list[str]:
    """Differences of this machine from the one that made the shard that can change bits.

    Empty where a replay must be equal bit for bit. Sums may depend on a processor's vector units.
    """
    manifest, found = run.manifest, list[str]()
    if _platform_name(manifest.platform) != _platform_name(platform.platform()):
        found.append(f"platform {manifest.platform}, here {platform.platform()}")
    here = _engines_here(run)
    for name, made in sorted(manifest.spec.engines.items()):
        if made != (there := here.get(name, "none")):
            found.append(f"{name} {made}, here {there}")
    cpu = run.commit_of(shard).host.cpu
    if cpu != this_host().cpu:
        found.append(f"processor {cpu}, here {this_host().cpu}")
    return found


def _engines_here(run: Run) -> dict[str, str]:
    spec = run.manifest.spec
    try:
        return scene_engines(spec) | label_engines(spec.label_source)
    except (PackageNotFoundError, InputError):
        return {}


def _platform_name(text: str) -> tuple[str, str]:
    """The platform string without the version of the kernel."""
    machine = platform.machine()
    return text.partition("-")[0], text.rpartition(machine)[2] if machine in text else text
