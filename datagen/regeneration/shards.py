"""Compute a shard again in this process, for checks, repairs and replays."""

from __future__ import annotations

from dataclasses import dataclass

from datagen.regeneration.sources import AS_FOUND, Sources
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.scene_rows import read_scenes
from datagen.schemas.shard_files import encode_shard
from datagen.workers.run_shard import ShardResult, run_shard
from datagen.workers.world import World, open_world


@dataclass(frozen=True, eq=False)
class OpenedSources:
    """The opened sources of a run's shards."""

    world: World
    scenes: Run | None  # the run whose scenes are labelled again


def open_sources(run: Run, given: Sources = AS_FOUND, needs_scenes: bool = True) -> OpenedSources:
    """Open the run's sources: those given, else those in its manifest.

    InputError where they do not exist, or differ from those that the run was made from. Without
    `needs_scenes` the run of --scenes-from may be missing, unless it is given: stored poses suffice to label
    again.
    """
    spec, known = run.manifest.spec, run.manifest.sources
    world = open_world(
        spec, given.houses or known.get("houses", "builtin"), given.objects or known.get("objects", "builtin")
    )
    if spec.scenes_from is None:
        return OpenedSources(world, None)
    try:
        return OpenedSources(world, source_of(run, given))
    except InputError:
        if needs_scenes or given.scenes_from is not None:
            raise
        return OpenedSources(world, None)


def source_of(run: Run, given: Sources = AS_FOUND) -> Run:
    """The run whose scenes this one labelled. InputError where it is missing or has other scenes."""
    place = given.scenes_from or run.manifest.sources.get("scenes_from", "")
    fix = "Give --scenes-from with the run that this one was started with"
    if not place:
        raise InputError(run.storage.url, "scenes_from", "is not in the run's manifest", fix)
    source = Run.open(place)
    if source.manifest.spec.scenes_hash != run.manifest.spec.scenes_hash:
        raise InputError(place, "spec_hash", "has other scenes than this run", fix)
    return source


def regenerate_shard(run: Run, shard: int, origin: OpenedSources) -> ShardResult:
    """Compute the shard's rows again; exceptions of the computation are not caught."""
    first = shard * run.layout.scenes_per_shard
    scenes = range(first, first + run.layout.scenes_per_shard)
    stored = None if origin.scenes is None else read_scenes(origin.scenes, scenes)
    return run_shard(run.manifest.spec, origin.world, scenes, stored, run.schema.version)


def regenerated_files(run: Run, made: ShardResult) -> dict[str, bytes]:
    """Compute the shard's files again, by path in the attempt's folder."""
    return encode_shard(run.schema, run.layout, run.manifest.spec_hash, made.scene, made.sample)
