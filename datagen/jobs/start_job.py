"""Open an existing run for a job; paths and commands that mean the same elsewhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

from datagen.configuration.robot_fields import refuse_missing_packages
from datagen.configuration.stored_scenes import StoredScenes, refuse_too_few
from datagen.console.command_lines import (
    absolute_path,
    absolute_robot,
    absolute_source,
    given_options,
    words_of,
)
from datagen.console.options import AS_FOUND, Sources
from datagen.jobs.job import JobOptions, JobRun
from datagen.replaying import open_sources, places_of
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.specification import Specification
from datagen.workers.engine_versions import refuse_other_engines
from datagen.workers.labels import load_label_source
from datagen.workers.rendering import load_renderer
from datagen.workers.robots import coordinates_of

Options = TypeVar("Options", bound=Any)  # a dataclass of options


def with_absolute_paths(options: Options) -> Options:
    """The options with absolute paths and sources: workers run elsewhere."""
    makers = dict.fromkeys(("out", "scenes_from", "config"), absolute_path)
    makers |= {"houses": absolute_source, "objects": absolute_source, "robot": absolute_robot}
    given = {name: getattr(options, name, None) for name in makers}
    return replace(
        options, **{name: makers[name](value) for name, value in given.items() if value is not None}
    )


def words_to_resume(path: str, options: JobOptions, moved: Sources = AS_FOUND) -> list[str]:
    """The words of the command that resumes a run in the same way; `moved`: new locations of its sources."""
    kept = JobOptions(workers=options.workers, address=options.address, no_seal=options.no_seal)
    sources = {
        "--houses": moved.houses,
        "--objects": moved.objects,
        "--robot": moved.robot,
        "--scenes-from": moved.scenes_from,
    }
    return ["resume", absolute_path(path), *words_of(sources | given_options(kept))]


def open_job_run(run: Run, given: Sources) -> JobRun:
    """Return an existing run with its sources, after a check that they are those it was made from.

    InputError where they are missing or differ, or where another version of an engine is installed: new
    shards would not fit the existing ones.
    """
    spec, known = run.manifest.spec, run.manifest.sources
    refuse_missing_packages(spec.label_source)
    load_label_source(spec.label_source)
    _ = run.schema  # InputError for an unknown schema version
    if given.scenes_from is not None and spec.scenes_from is None:
        problem = f"{run.storage.url} has its own scenes"
        raise InputError("--scenes-from", given.scenes_from, problem, "Omit --scenes-from")
    refuse_other_engines(f"{run.storage.url}/manifest.json", spec)
    open_sources(run, given)
    refuse_unusable_engines(spec)
    houses, objects, robot = places_of(run, given)
    scenes_from = ""
    if spec.scenes_from is not None:
        scenes_from = absolute_path(given.scenes_from or known["scenes_from"])
        if run.missing():
            refuse_too_few(StoredScenes(Run.open(scenes_from), houses, objects), run.layout, run.n)
    return JobRun(run, absolute_source(houses), absolute_source(objects), scenes_from, absolute_robot(robot))


def refuse_unusable_engines(spec: Specification) -> None:
    """Raise InputError for a robot or a renderer that does not work on this machine."""
    if spec.arm is not None:
        count = coordinates_of(spec.arm.robot_key)
        if count != (spec.arm.joints or 7):
            problem = f"moves {count} joints here, and {spec.arm.joints or 7} in the run"
            fix = "Start a new run, or use the version of the program that the run was made with"
            raise InputError("--robot", spec.arm.robot, problem, fix)
    if spec.scenes_from is None:
        load_renderer(spec.observation.renderer)
