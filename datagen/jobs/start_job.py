"""Open the sources of an existing run and start its job, for `submit`, `resume` and `extend`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError

from datagen.configuration.arms import refuse_missing_packages
from datagen.configuration.specify import label_engines, scene_engines
from datagen.console.command_lines import Interrupted, command_line, resumable, words_of
from datagen.console.options import AS_FOUND, Sources
from datagen.console.printing import counted
from datagen.doctor.engines import probe_render_device
from datagen.jobs.detach import detach_job, detached_words
from datagen.jobs.dry_run import PlannedRun, dry_run
from datagen.jobs.job import JobPlan, JobRun, run_job
from datagen.jobs.job_report import JobResult
from datagen.jobs.options import JobOptions, absolute_path, absolute_source, opening
from datagen.regeneration.scenes import open_sources
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.record_files import different_fields
from datagen.schemas.run import Run
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.specification import Specification
from datagen.schemas.storage import Storage, open_storage
from datagen.workers.extras import missing_library
from datagen.workers.labels import load_label_source
from datagen.workers.robots import gripper_of


def source_words(given: Sources) -> list[str]:
    """The options for the same sources, with absolute paths."""
    return words_of(
        {
            "--houses": given.houses and absolute_source(given.houses),
            "--objects": given.objects and absolute_source(given.objects),
            "--scenes-from": given.scenes_from and absolute_path(given.scenes_from),
        }
    )


def open_job_run(run: Run, given: Sources, address: str) -> JobRun:
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
    refuse_unusable_engines(spec, address)
    return JobRun(
        run,
        absolute_source(given.houses or known.get("houses", "builtin")),
        absolute_source(given.objects or known.get("objects", "builtin")),
        "" if spec.scenes_from is None else absolute_path(given.scenes_from or known["scenes_from"]),
    )


def continue_job(
    words: Sequence[str],
    path: str,
    given: Sources,
    job_options: JobOptions,
    prepare: Callable[[Sequence[JobRun]], None],
    planned: Callable[[Sequence[JobRun]], Sequence[PlannedRun]],
) -> JobResult:
    """Open the run, or merged runs, at `path`, let `prepare` change them, and make the missing shards.

    A dry run forecasts the shards of `planned` instead.

    `words` are those of the command itself: a detached job runs it again, `prepare` included.
    """
    if job_options.detach and job_options.address != "local":
        return detach_job(words, path, job_options)
    with opening(words, job_options) as began_s:
        storage = open_storage(path, probe=not job_options.dry_run, create=False)
        job_runs = [open_job_run(run, given, job_options.address) for run in open_runs(storage)]
        if not job_options.dry_run:
            prepare(job_runs)
    if job_options.dry_run:
        return dry_run(path, planned(job_runs), job_options, began_s)
    if job_options.detach:
        return detach_job(words, path, job_options)
    command = [*words, *job_options.address_words()]
    return start_job(storage, path, job_runs, job_options, began_s, command, given)


def planned_run(job_run: JobRun, n: int, quarantined: bool = False) -> PlannedRun:
    """The shards that a run of n labels lacks; with `quarantined`, also those in quarantine."""
    run = job_run.run
    decided = run.committed() if quarantined else run.committed() | run.quarantined()
    shards = len(ShardRanges.of(range(run.layout.shards_for(n))).without(ShardRanges.of(decided)))
    sources = job_run.houses, job_run.objects, job_run.scenes_from
    return PlannedRun(run.manifest, run, n, shards, *sources)


def start_job(
    storage: Storage,
    path: str,
    job_runs: Sequence[JobRun],
    job_options: JobOptions,
    began_s: float,
    command: Sequence[str],
    given: Sources = AS_FOUND,
    resume: Sequence[str] | None = None,
) -> JobResult:
    """Make the missing shards. Raises Interrupted where the job was asked to stop.

    `resume` are the words of the command that resumes, by default `datagen resume`.
    """
    words = list(resume or ["resume", absolute_path(path), *source_words(given), *job_options.words()])
    words += detached_words() or job_options.address_words()
    with resumable(words):
        result = run_job(JobPlan(storage, path, job_runs, job_options, began_s, command, words))
    if result.end == "interrupted":
        left = counted(result.remaining, "shard")
        raise Interrupted(f"{left} left. Resume with: {command_line(result.resume)}", result)
    return result


def refuse_unusable_engines(spec: Specification, address: str) -> None:
    """Raise InputError for a robot or a renderer that does not work on this machine."""
    if spec.arm is not None:
        gripper_of(spec.arm.robot)
    if address == "local" and spec.scenes_from is None and spec.observation.renderer == "sapien":
        device = probe_render_device()
        if not device.succeeded:
            problem, fix = f"finds no render device ({device.text})", "Use embree, or see `datagen doctor`"
            raise InputError("--renderer", "sapien", problem, fix)


def refuse_other_engines(place: str, spec: Specification) -> None:
    """Raise InputError for a specification of other versions of the label code or of engines than here."""
    try:
        here = label_engines(spec.label_source)
        if spec.scenes_from is None:  # stored scenes need no scene engines
            here |= scene_engines(spec)
    except PackageNotFoundError as error:
        missing = missing_library(error)
        fix = missing.fix if missing else "Install it"
        raise InputError(place, "engines", f"{error.name} is not installed", fix) from None
    made = {name: version for name, version in spec.engines.items() if name in here}
    rows = [f"{name}: the run has {a}, this machine {b}" for name, a, b in different_fields(made, here)]
    if rows:
        fix = "Install the run's versions, or start a new run"
        raise InputError(place, "engines", "; ".join(rows), fix)
