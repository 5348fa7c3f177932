"""Make scenes and shards of a run again, from their seeds or from the stored poses."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError

import numpy as np

from datagen.cluster.attempt_guard import this_host
from datagen.configuration.specify import label_engines, scene_engines
from datagen.console.options import AS_FOUND, Sources
from datagen.schemas.cost import StageClock
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Run
from datagen.schemas.scene_rows import read_scenes
from datagen.schemas.shard_files import encode_shard
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.labels import load_label_source
from datagen.workers.run_shard import Columns, ShardResult, candidate_columns, run_shard, scene_row
from datagen.workers.scenes import SettledScene
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from datagen.workers.world import World, assemble_world, open_world

_NO_SCENES = "the run that made the scenes does not exist any more"
_FIX = "Give that run with --scenes-from"


@dataclass(frozen=True, eq=False)
class Replayer:
    """A run opened to make its scenes again; `sampling_world` is None without the run that sampled them."""

    run: Run
    world: World
    sampling_world: World | None

    def sample_again(self, scene: int, rows: Sequence[int] | None = None) -> SceneRows:
        """Sample scene `scene` from its seeds as a worker does, rejections included, and label it.

        `rows` selects the candidates to label; by default all. Raises InputError where no scene can be made.
        """
        if self.sampling_world is None:
            raise InputError(self.run.storage.url, "scenes_from", _NO_SCENES, _FIX)
        sampled, candidates = generate_scene(self.sampling_world, scene, StageClock())
        plain = scene_row(sampled)
        fields = self.run.schema.scene_fields
        record = {f.name: np.array(plain[f.name], object if f.is_text else f.dtype) for f in fields}
        settled: SettledScene = sampled
        if self.sampling_world is not self.world:  # the scene of another run is labelled from its record
            settled = reconstruct_scene(self.world, record)
        chosen = range(len(candidates)) if rows is None else rows
        return SceneRows(record, self._samples(settled, candidates, chosen))

    def recompute(self, stored: SceneRows, rows: Sequence[int]) -> SceneRows:
        """Label the candidates `rows` of a stored scene again from the stored poses.

        InputError where the record names a missing house or object, or has invalid poses.
        """
        scene = reconstruct_scene(self.world, stored.record)
        candidates = reconstruct_candidates(stored.samples, scene)
        return SceneRows(stored.record, self._samples(scene, candidates, rows))

    def _samples(self, scene: SettledScene, candidates: SceneCandidates, rows: Sequence[int]) -> Columns:
        spec = self.run.manifest.spec
        source = load_label_source(spec.label_source)
        common = candidate_columns(scene.index, candidates, self.run.manifest.spec_hash, source)
        chosen = {name: values[list(rows)] for name, values in common.items()}
        return chosen | source.columns(scene, candidates, spec, rows)


def open_replayer(run: Run, origin: OpenedSources) -> Replayer:
    """Open a run to make its scenes again from its sources."""
    sampled_by = run if origin.scenes is None else origin.scenes
    while sampled_by is not None and sampled_by.manifest.spec.scenes_from is not None:
        try:
            sampled_by = source_of(sampled_by)
        except InputError:
            sampled_by = None
    if sampled_by is run:
        return Replayer(run, origin.world, origin.world)
    if sampled_by is None:
        return Replayer(run, origin.world, None)
    houses, objects = origin.world.houses, origin.world.objects
    sampling_world = assemble_world(sampled_by.manifest.spec, houses, objects, "--houses", "--objects")
    return Replayer(run, origin.world, sampling_world)


def chosen_rows(stored: SceneRows, rows: Sequence[int]) -> SceneRows:
    """The same scene with these of its samples."""
    return SceneRows(stored.record, {name: values[list(rows)] for name, values in stored.samples.items()})


def what_differs_here(run: Run, shard: int | None = None) -> list[str]:
    """Differences of this machine from the one that made the run that can change bits.

    Empty where a replay must be equal bit for bit. With `shard`, the processor of its commit counts too: sums
    may depend on its vector units.
    """
    manifest = run.manifest
    found: list[str] = []
    if _platform_name(manifest.platform) != _platform_name(platform.platform()):
        found.append(f"platform {manifest.platform}, here {platform.platform()}")
    here = _engines_here(run)
    for name, made in sorted(manifest.spec.engines.items()):
        if made != (there := here.get(name, "none")):
            found.append(f"{name} {made}, here {there}")
    if shard is not None:
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
    path = given.scenes_from or run.manifest.sources.get("scenes_from", "")
    fix = "Give --scenes-from with the run that this one was started with"
    if not path:
        raise InputError(run.storage.url, "scenes_from", "is not in the run's manifest", fix)
    source = Run.open(path)
    if source.manifest.spec.scenes_hash != run.manifest.spec.scenes_hash:
        raise InputError(path, "spec_hash", "has other scenes than this run", fix)
    return source


def regenerate_shard(run: Run, shard: int, origin: OpenedSources) -> ShardResult:
    """Compute the shard's rows again; exceptions of the computation are not caught."""
    first = shard * run.layout.scenes_per_shard
    scenes = range(first, first + run.layout.scenes_per_shard)
    stored = None if origin.scenes is None else list(read_scenes(origin.scenes, scenes))
    return run_shard(run.manifest.spec, origin.world, scenes, stored, run.schema.version)


def regenerated_files(run: Run, made: ShardResult) -> dict[str, bytes]:
    """Compute the shard's files again, by path in the attempt's folder."""
    return encode_shard(run.schema, run.layout, run.manifest.spec_hash, made.scene, made.sample)
