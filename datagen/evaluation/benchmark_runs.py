"""Make the runs of a benchmark with ordinary jobs, from the houses and objects that it names."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from datagen.assets.object_split import split_objects
from datagen.configuration.specify import layout_of, manifest_of
from datagen.console.command_lines import absolute_source
from datagen.console.options import Sources
from datagen.evaluation.benchmark import BenchmarkRun
from datagen.jobs.job import Job, JobOptions
from datagen.jobs.job_report import JobResult
from datagen.jobs.start_job import open_job_run
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import Manifest
from datagen.schemas.storage import open_storage
from datagen.workers.engine_versions import refuse_other_engines
from datagen.workers.survey import stored_notes, survey_sources
from datagen.workers.world import open_world


def divided_objects(objects: str, out: Path, runs: Mapping[str, BenchmarkRun]) -> dict[str, str]:
    """Return the objects of each part; split them into OUT/objects if a run uses a part of them.

    InputError for objects that are no folder with an objects.json.
    """
    parts = {"all": absolute_source(objects)}
    if any(run.objects != "all" for run in runs.values()):
        kind, _, folder = objects.partition(":")
        if kind != "ycb":
            fix = "Give ycb:DIR, a folder with an objects.json"
            raise InputError("--objects", objects, "cannot be divided into train and test", fix)
        split_objects(Path(folder).expanduser(), out / "objects")
        parts |= {part: absolute_source(f"ycb:{out / 'objects' / part}") for part in ("train", "test")}
    return parts


def make_runs(
    runs: Mapping[str, BenchmarkRun],
    houses: str,
    objects: Mapping[str, str],
    out: Path,
    options: JobOptions,
    words: list[str],
) -> Iterator[JobResult]:
    """Make each run in its folder of `out` and yield the result of its job; complete runs do not change.

    InputError, before the first job starts, if houses, objects or engines differ from the definition's: the
    labels would differ too. `words` are those of the command, which also resumes.
    """
    manifests: dict[str, Manifest] = {}
    with options.display() as shown:
        shown.phase("opening houses and objects")
        for name, wanted in runs.items():
            refuse_other_engines(f"benchmark run {name}", wanted.spec)
            world = open_world(wanted.spec, houses, objects[wanted.objects])
            surveys = survey_sources(world.houses, world.objects, shown.counter("houses examined"))
            counts = stored_notes(world, surveys)
            sources = {"houses": houses, "objects": objects[wanted.objects], **counts}
            manifests[name] = manifest_of(wanted.spec, layout_of(wanted.spec, wanted.n), sources)
    for name, wanted in runs.items():
        run = Run.create_or_open(open_storage(out / name), manifests[name], wanted.n)
        given = Sources(houses=houses, objects=objects[wanted.objects])
        job_run = open_job_run(run, given)
        job = Job(run.storage, str(out / name), [job_run], options, time.monotonic(), words, words)
        yield job.run()
