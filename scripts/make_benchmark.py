"""Make the runs of the frozen benchmark, and compare their digests with the frozen ones.

    python -m scripts.make_benchmark --houses procthor:DIR --objects ycb:DIR --out RUNS [--run NAME]

The same command resumes. Houses, objects and engines must be those that the definition names: the same
specification gives the same labels on the same platform. RUNS/benchmark.json is another definition, and
RUNS/objects gets the training and test parts of the objects.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from datagen.assets.object_split import split_objects
from datagen.configuration.specify import layout_of, manifest_of
from datagen.console.command_lines import Interrupted, absolute_path, absolute_source
from datagen.console.options import Sources
from datagen.evaluation.benchmark import BenchmarkRun, read_benchmark, refuse_differing
from datagen.jobs.job import Job, JobOptions
from datagen.jobs.job_report import JobResult, print_job
from datagen.jobs.start_job import open_job_run, words_to_resume
from datagen.schemas.errors import InputError, choices
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
) -> Iterator[JobResult]:
    """Make each run in its folder of `out` and yield the result of its job; complete runs do not change.

    InputError, before the first job starts, if houses, objects or engines differ from the definition's: the
    labels would differ too.
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
        words = words_to_resume(str(out / name), options)
        job = Job(run.storage, str(out / name), [job_run], options, time.monotonic(), words, words)
        yield job.run()


def main(words: Sequence[str] | None = None) -> int:
    """Make the runs and print their results; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--houses", required=True, help="procthor:DIR with the benchmark's houses")
    parser.add_argument("--objects", required=True, help="ycb:DIR with the benchmark's objects")
    parser.add_argument("--out", required=True, help="folder for the runs")
    parser.add_argument("--run", action="append", default=[], help="a run to make; repeat for more")
    parser.add_argument("--workers", type=int, help="processes; 0: this one (default: one per core)")
    given = parser.parse_args(words)
    try:
        return _make(given.houses, given.objects, Path(absolute_path(given.out)), given.run, given.workers)
    except Interrupted as stopped:
        return print_job(stopped.result)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2


def _make(houses: str, objects: str, out: Path, names: Sequence[str], workers: int | None) -> int:
    options = JobOptions(workers=workers)
    options.refuse_bad()
    definition = read_benchmark(out)
    for name in names:
        if name not in definition.runs:
            problem = f"is no run of benchmark {definition.version}"
            raise InputError("--run", name, problem, choices(definition.runs, name))
    runs = {name: run for name, run in definition.runs.items() if not names or name in names}
    parts = divided_objects(absolute_source(objects), out, runs)
    for result in make_runs(runs, absolute_source(houses), parts, out, options):
        if print_job(result):
            return result.exit_code
    for name, wanted in runs.items():
        refuse_differing(str(out / name), name, wanted, definition.version)
        print(f"{name}: {'candidates and labels as frozen' if wanted.digests else 'not frozen yet'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
