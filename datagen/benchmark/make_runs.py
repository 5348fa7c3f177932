"""Make the runs of a benchmark with ordinary jobs, from the houses and objects that it names."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from datagen.assets.object_split import split_objects
from datagen.benchmark.definition import BenchmarkRun
from datagen.configuration.specify import layout_of, manifest_of
from datagen.console.options import Sources
from datagen.jobs.job import Job, JobOptions
from datagen.jobs.job_report import JobResult
from datagen.jobs.start_job import absolute_source, open_job_run, refuse_other_engines
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import refuse_other
from datagen.schemas.run import Run
from datagen.schemas.run_records import Manifest
from datagen.schemas.storage import open_storage
from datagen.workers.world import open_world


@dataclass(frozen=True)
class BenchmarkSources:
    """References of the houses, and of the objects of each part."""

    houses: str
    objects: Mapping[str, str]


def divided_sources(
    houses: str, objects: str, out: Path, runs: Mapping[str, BenchmarkRun]
) -> BenchmarkSources:
    """Return the sources of `runs`; split the objects into OUT/objects if a run uses a part of them.

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
    return BenchmarkSources(absolute_source(houses), parts)


def make_runs(
    runs: Mapping[str, BenchmarkRun],
    sources: BenchmarkSources,
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
            objects = sources.objects[wanted.objects]
            refuse_other_engines(f"benchmark run {name}", wanted.spec)
            world = open_world(wanted.spec, sources.houses, objects)
            counts = {"n_houses": str(len(world.house_ids)), "n_objects": str(len(world.object_names))}
            references = {"houses": sources.houses, "objects": objects}
            manifests[name] = manifest_of(wanted.spec, layout_of(wanted.spec, wanted.n), references | counts)
            if (out / name / "manifest.json").is_file():
                run = Run.open(out / name)
                refuse_other(run.storage.url, run.manifest, manifests[name])
    for name, wanted in runs.items():
        run = Run.create_or_open(open_storage(out / name), manifests[name], wanted.n)
        given = Sources(houses=sources.houses, objects=sources.objects[wanted.objects])
        job_run = open_job_run(run, given, options.address)
        job = Job(run.storage, str(out / name), [job_run], options, time.monotonic(), words, words)
        yield job.run()
