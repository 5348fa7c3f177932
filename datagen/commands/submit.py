"""`datagen submit`: make labels. The same command on the same folder resumes the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from datagen.configuration.robot_fields import refuse_missing_packages
from datagen.configuration.specify import layout_of, manifest_of, specify
from datagen.configuration.stored_scenes import (
    layout_again,
    open_stored_scenes,
    refuse_too_few,
    specify_again,
    specify_view,
)
from datagen.console.command_lines import (
    absolute_source,
    beginning_s,
    given_options,
    options_of,
    prints,
    words_of,
)
from datagen.console.options import LABELLED, ROBOT, RUNNING, Whole, option
from datagen.display.progress import Progress
from datagen.jobs.detach import detach_job
from datagen.jobs.job import Job, JobOptions, JobRun
from datagen.jobs.job_report import JobResult, print_job
from datagen.jobs.start_job import (
    refuse_unusable_engines,
    with_absolute_paths,
    words_to_resume,
)
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MERGED, refuse_other
from datagen.schemas.run import Run, refuse_odd_n
from datagen.schemas.run_records import Manifest, StageClock
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import open_storage
from datagen.workers.houses import open_houses
from datagen.workers.labels import load_label_source
from datagen.workers.objects import open_objects
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.survey import Survey, stored_notes, survey_sources
from datagen.workers.world import World, assemble_world, open_world

# Options that --scenes-from decides.
_OF_SCENES = ("--seed", "--split", "--candidates", "--candidates-per-scene")
# Options that --view leaves as they were.
_OF_LABELS = ("--config", "--robot", "--perturb", "--draws")
_BUILTIN = (
    "Using built-in houses. For real ones: datagen assets fetch procthor-10k --out DIR, then "
    "--houses procthor:DIR/procthor"
)


def _text(text: str) -> Parameter:
    """An option whose number is read as text: "grid" is not one."""
    return Parameter(
        converter=lambda kind, tokens: tokens[0].value, n_tokens=1, metavar="STR", help=text, group=LABELLED
    )


def _path(text: str) -> Parameter:
    return Parameter(metavar="STR", help=text, group=LABELLED)


@dataclass(frozen=True, kw_only=True)
class SubmitOptions(JobOptions):
    """Options of `submit`."""

    label_source: Annotated[str, Parameter(name="LABEL_SOURCE", help="heuristic, plan or sim.")] = field(
        kw_only=False
    )
    n: Annotated[Whole, option("Labels wanted; a larger number extends the run.", LABELLED)]
    out: Annotated[str | Path, _path("Folder or s3:// address of the run.")]
    houses: Annotated[
        str | None, option("builtin, or procthor, ai2thor, habitat or map:PATH. [default: builtin]", LABELLED)
    ] = None
    objects: Annotated[str | None, option("builtin, folder:DIR or ycb:DIR. [default: builtin]", LABELLED)] = (
        None
    )
    scenes_from: Annotated[
        str | Path | None, _path("Run whose scenes and candidates are labelled again.")
    ] = None
    view: Annotated[
        Whole | None,
        option(
            "With --scenes-from: keep labels, and observe the scenes from this other viewpoint.", LABELLED
        ),
    ] = None
    candidates: Annotated[
        Literal["grid", "clear", "in-range"] | None,
        option(
            "Cells to sample from: all, those with a clear base, or those also within reach. [default: grid]",
            LABELLED,
        ),
    ] = None
    candidates_per_scene: Annotated[
        int | str | None,
        _text("Candidates per scene, or grid for all 625. [default: 60; grid for plan and sim of all cells]"),
    ] = None
    split: Annotated[
        Literal["train", "val", "test", "all"] | None,
        option("Split of the houses; splits share no house. [default: all]", LABELLED),
    ] = None
    seed: Annotated[Whole | None, option("Seed of the whole run. [default: 0]", LABELLED)] = None
    config: Annotated[
        str | Path | None,
        Parameter(
            metavar="PATH", help="TOML file with any other field of the specification.", group=LABELLED
        ),
    ] = None
    robot: Annotated[
        str | None,
        option(
            "fetch, panda, panda-scaled, pr2, stretch3, tiago-pro, ur5, xarm7, or a file ROBOT.toml; sets "
            "reach and height. "
            "[default: any for heuristic, panda-scaled for plan and sim]",
            ROBOT,
        ),
    ] = None
    perturb: Annotated[
        Whole | None,
        option(
            "Arrivals per candidate, with random errors of pose; in sim also of the world. "
            "[default: 1, without errors]",
            ROBOT,
        ),
    ] = None
    draws: Annotated[
        Whole | None,
        option("Independent plans per candidate, whose rate is stored; plan labels. [default: 1]", ROBOT),
    ] = None
    dry_run: Annotated[
        bool,
        option("Check everything, make nothing; print shards, scenes, unusable houses and objects.", RUNNING),
    ] = False


@prints(print_job)
@options_of(SubmitOptions)
def submit(options: SubmitOptions) -> JobResult:
    """Make labels: start a run, or resume the run in the folder.

    To train a model, make plan labels with --candidates in-range; to repeat the paper, heuristic labels; to
    measure success in physics, sim labels. Plan and sim labels in-range have their targets by default where
    parking decides: on tops and shelves, in cupboards, on seats, floors, in sinks. scene.places = {} in the
    --config file keeps open tops alone, for a quarter of the cost.

    The same command on the same folder resumes the run, and a larger --n extends it; other options are
    refused with the fields that differ. Ctrl-C finishes the running attempts, a second Ctrl-C stops at once;
    committed shards are kept.

    For example: datagen submit heuristic --n 1e5 --out runs/first

    Returns:
        The result of the job. The call blocks and reports progress on standard error, unless `quiet`.

    Raises:
        InputError: An option, a source or the run cannot be used.
        KeyboardInterrupt: The job was stopped; the run can be resumed.

    Examples:
        >>> result = datagen.submit(
        ...     "heuristic", n=8, out=folder / "new", candidates_per_scene=8, workers=0, quiet=True
        ... )
        >>> result.complete, result.labels, result.path == str(folder / "new")
        (True, 8, True)
    """
    began_s, path, label_source = beginning_s(), str(options.out), options.label_source
    refuse_missing_packages(label_source)
    load_label_source(label_source)  # InputError for an unknown one
    refuse_odd_n(options.n)
    options.refuse_bad()
    options = with_absolute_paths(options)
    words = ["submit", label_source, *words_of(given_options(replace(options, dry_run=False)))]
    with options.display() as shown:
        shown.phase("opening houses and objects")
        run, manifest, surveys = _specified(options, shown)
    if not options.quiet:
        _report(surveys, options)
    if options.houses is None and options.scenes_from is None and not options.quiet:
        Progress(options.json).say("note", {"note": _BUILTIN}, _BUILTIN)
    if options.dry_run:
        return _dry_run(path, run, manifest, options.n, words)
    if run is None:
        run = Run.create_or_open(open_storage(path), manifest, options.n)
    else:
        run.grow(options.n)
    again = words_to_resume(path, options)
    if options.detach:
        return detach_job(again, path)
    sources = manifest.sources
    more = sources.get("scenes_from", ""), sources.get("robot", "")
    job_run = JobRun(run, sources["houses"], sources["objects"], *more)
    return Job(run.storage, path, [job_run], options, began_s, words, again).run()


def _specified(options: SubmitOptions, shown: Progress) -> tuple[Run | None, Manifest, Mapping[str, Survey]]:
    """The run at `out`, None where there is none yet, the manifest of the options, and what was left out.

    InputError where they differ and, before anything is written, where no scene can be made.
    """
    run, label_source = _existing_run(str(options.out)), options.label_source
    config = None if options.config is None else Path(options.config)
    chosen = options.robot, options.perturb, options.draws
    surveys: Mapping[str, Survey] = {}
    if options.scenes_from is None:
        if options.view is not None:
            fix = "Give --scenes-from with the run whose scenes are observed"
            raise InputError("--view", str(options.view), "has no scenes", fix)
        houses, objects = options.houses or "builtin", options.objects or "builtin"
        house_source, object_source = open_houses(houses), open_objects(objects)
        fields = {"seed": options.seed, "split": options.split, **_candidate_fields(options)}
        spec = specify(label_source, house_source, object_source, fields, config, *chosen)
        world = assemble_world(spec, house_source, object_source, houses, objects)
        refuse_unusable_engines(spec)
        if run is None:
            _refuse_no_scene(world, houses)
        surveys = survey_sources(house_source, object_source, shown.counter("houses examined"))
        layout = layout_of(spec, options.n)
        stored_in = stored_notes(world, surveys)
    else:
        given = given_options(options)
        stored = open_stored_scenes(
            str(options.scenes_from),
            options.houses,
            options.objects,
            {name: given[name] for name in _OF_SCENES if name in given},
        )
        if options.view is None:
            spec = specify_again(label_source, stored, config, *chosen)
        else:
            kept = {name: given[name] for name in _OF_LABELS if name in given}
            spec = specify_view(label_source, stored, kept, options.view)
        houses, objects = stored.houses, stored.objects
        world = open_world(spec, houses, objects, options.robot or stored.robot)
        refuse_unusable_engines(spec)
        layout = layout_again(spec, stored, options.n) if run is None else run.layout
        refuse_too_few(stored, layout, options.n)
        known = stored.run.manifest.sources
        stored_in = {**known, "scenes_from": stored.run.storage.url}
        if options.robot is not None:
            stored_in.pop("robot", None)
    sources = {"houses": absolute_source(houses), "objects": absolute_source(objects)}
    if spec.arm is not None and options.robot is not None and options.robot.endswith(".toml"):
        sources["robot"] = options.robot
    manifest = manifest_of(spec, layout, stored_in | sources)
    if run is not None:
        refuse_other(run.storage.url, run.manifest, manifest)
    return run, manifest, surveys


def _report(surveys: Mapping[str, Survey], options: SubmitOptions) -> None:
    """Print a line for each source with files; a dry run also prints each unusable house and object."""
    progress = Progress(options.json)
    for what, survey in surveys.items():
        source = f"{str(getattr(options, what)).partition(':')[0]} {what}"
        reasons = survey.unusable if options.dry_run else {}
        counts = {"read": survey.read, "unusable": survey.causes, "findings": survey.findings}
        if options.json:
            progress.say("source", {"source": source, **counts, "reasons": reasons}, "")
        else:
            for line in survey.lines(source, with_reasons=options.dry_run):
                progress.say("", {}, line)


def _dry_run(path: str, run: Run | None, manifest: Manifest, n: int, words: list[str]) -> JobResult:
    """The shards and scenes that the run at `path` lacks, and the command that makes them."""
    layout = manifest.layout if run is None else run.layout
    missing = ShardRanges.of(range(layout.shards_for(n)))
    if run is not None:
        n = max(n, run.n)
        decided = ShardRanges.of(run.committed() | run.quarantined())
        missing = ShardRanges.of(range(layout.shards_for(n))).without(decided)
    shards = len(missing)
    return JobResult(
        path=path,
        end="dry-run",
        n=n,
        made_from=manifest.made_from,
        shards=shards,
        remaining=shards,
        scenes=shards * layout.scenes_per_shard,
        resume=tuple(words),
    )


def _existing_run(out: str) -> Run | None:
    """The run at `out`; None where there is none yet. InputError for merged runs."""
    try:
        storage = open_storage(out, probe=False, create=False)
    except InputError:
        return None  # nothing there, or an address that `open_storage` refuses
    if storage.exists(MERGED):
        fix = "Extend it with `datagen resume RUN --n N`, or choose another --out"
        raise InputError(out, "", "holds merged runs, each with its own specification", fix)
    if not storage.exists("manifest.json"):
        return None
    run = Run.open(storage)
    _ = run.schema  # InputError for an unknown version
    return run


def _refuse_no_scene(world: World, houses: str) -> None:
    """Raise InputError, before anything is written, where a new run's first scene cannot be made."""
    try:
        generate_scene(world, 0, StageClock())
    except InputError as error:
        raise InputError("--houses", houses, f"no scene can be made: {error.problem}", error.fix) from error


def _candidate_fields(options: SubmitOptions) -> dict[str, Any]:
    kind, number = options.candidates, _per_scene(options.candidates_per_scene)
    if kind == "grid":
        if number not in (None, "grid"):
            fix = "Give --candidates clear or in-range to sample some, or omit the number"
            raise InputError("--candidates-per-scene", str(number), "a grid has all its cells", fix)
        number = "grid"
    elif kind is not None and number == "grid":
        problem = f"a whole grid has cells that are not {kind}"
        raise InputError("--candidates", kind, problem, "Give --candidates-per-scene 60")
    return {"candidates.per_scene": number, "candidates.within": kind if kind != "grid" else None}


def _per_scene(given: int | str | None) -> int | str | None:
    text = str(given)
    if given is None or text == "grid":
        return given
    if not (text.isascii() and text.isdigit() and len(text) < 9) or not 1 <= int(text) <= 625:
        raise InputError(
            "--candidates-per-scene", text, "is neither grid nor a number from 1 to 625", "Give 60 or grid"
        )
    return int(text)
