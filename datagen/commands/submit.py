"""`datagen submit`: make labels. The same command on the same folder resumes the run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Unpack

from cyclopts import Parameter

from datagen.configuration.arms import refuse_missing_packages
from datagen.configuration.manifest import manifest_of
from datagen.configuration.specify import layout_of, specify
from datagen.configuration.stored_scenes import (
    layout_again,
    open_stored_scenes,
    refuse_too_few,
    specify_again,
)
from datagen.console.command_lines import prints, words_of
from datagen.console.options import File, PathOrAddress, Whole
from datagen.display.progress import Progress
from datagen.jobs.detach import detach_job
from datagen.jobs.dry_run import PlannedRun, dry_run
from datagen.jobs.job import JobRun
from datagen.jobs.job_report import JobResult, print_job
from datagen.jobs.options import (
    JobKeywords,
    JobOptions,
    absolute_path,
    absolute_source,
    opening,
    refuse_odd_n,
)
from datagen.jobs.start_job import planned_run, refuse_unusable_engines, start_job
from datagen.schemas.cost import StageClock
from datagen.schemas.errors import InputError
from datagen.schemas.keys import MERGED
from datagen.schemas.record_files import refuse_other
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout, Manifest
from datagen.schemas.storage import open_storage
from datagen.workers.houses import open_houses
from datagen.workers.labels import load_label_source
from datagen.workers.objects import open_objects
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.world import World, assemble_world, open_world

# Options that --scenes-from decides.
_OF_SCENES = (
    *("--seed", "--split", "--candidates", "--candidates-per-scene", "--robots-per-scene"),
    *("--settler", "--renderer", "--noise"),
)
# A number is read as text: "grid" is not one.
_TEXT = Parameter(converter=lambda kind, tokens: tokens[0].value, n_tokens=1, metavar="STR")
_BUILTIN = (
    "Using built-in houses. For real ones: datagen assets fetch procthor-10k --out DIR, then "
    "--houses procthor:DIR/procthor"
)


@prints(print_job)
def submit(
    label_source: Annotated[str, Parameter(name="LABEL_SOURCE")],
    /,
    *,
    n: Whole,
    out: PathOrAddress,
    houses: str | None = None,
    objects: str | None = None,
    scenes_from: PathOrAddress | None = None,
    robot: str | None = None,
    perturb: Whole | None = None,
    candidates: Literal["grid", "clear", "in-range"] | None = None,
    candidates_per_scene: Annotated[int | str | None, _TEXT] = None,
    robots_per_scene: Whole | None = None,
    split: Literal["train", "val", "test", "all"] | None = None,
    seed: Whole | None = None,
    settler: str | None = None,
    renderer: str | None = None,
    noise: bool = False,
    config: File | None = None,
    **job: Unpack[JobKeywords],
) -> JobResult:
    """Make labels: start a run, or resume the run in the folder.

    To train a model, make plan labels with --candidates in-range; to repeat the paper, heuristic labels; to
    measure success in physics, sim labels.

    The same command on the same folder resumes the run, and a larger --n extends it; other options are
    refused with the fields that differ. Ctrl-C finishes the running attempts, a second Ctrl-C stops at once;
    committed shards are kept.

    For example: datagen submit heuristic --n 1e5 --out runs/first

    Args:
        label_source: heuristic, plan or sim.
        n: Labels wanted; a larger number extends the run.
        out: Folder or s3:// address of the run.
        houses: builtin, procthor:DIR or ai2thor:DIR [builtin].
        objects: builtin or ycb:DIR [builtin].
        scenes_from: Run whose scenes and candidates are labelled again.
        robot: fetch, panda, panda-scaled or xarm7; sets reach and height [plan, sim: panda-scaled].
        perturb: Arrivals per candidate, with random errors of pose; in sim also of the world [1, without].
        candidates: Cells to sample from: all, those with a clear base, or those also within reach [grid].
        candidates_per_scene: Candidates sampled per scene from the 25x25 grid, or grid for all 625 [60].
        robots_per_scene: Robots that share a scene's candidates [4; 1 on a whole grid].
        split: Split of the houses; splits share no house [all].
        seed: Seed of the whole run [0].
        settler: Physics engine: sapien or pybullet [sapien where installed].
        renderer: Renderer: embree, sapien or pybullet [embree].
        noise: Add sensor noise to the frame.
        config: TOML file with any field of the specification.
        job: `workers`, `address`, `max_quarantined`, `detach`, `dry_run`, `budget`, `prices`, `json`, and
            `quiet` to report no progress.

    Returns:
        The result of the job. The call blocks and reports progress on standard error.

    Raises:
        InputError: An option, a source or the run cannot be used.
        KeyboardInterrupt: The job was stopped; the run can be resumed.

    Example:
        >>> result = datagen.submit(
        ...     "heuristic", n=8, out=folder / "new", candidates_per_scene=8, workers=0, quiet=True
        ... )
        >>> result.complete, result.labels, result.path == str(folder / "new")
        (True, 8, True)
    """
    out, job_options = str(out), JobOptions(**job)
    scenes_from = None if scenes_from is None else str(scenes_from)
    config = None if config is None else Path(config)
    refuse_missing_packages(label_source)
    load_label_source(label_source)  # InputError for an unknown one
    refuse_odd_n(n)
    job_options.refuse_bad()
    given = {
        "--n": n,
        "--out": absolute_path(out),
        "--houses": houses and absolute_source(houses),
        "--objects": objects and absolute_source(objects),
        "--scenes-from": scenes_from and absolute_path(scenes_from),
        "--robot": robot,
        "--perturb": perturb,
        "--candidates": candidates,
        "--candidates-per-scene": candidates_per_scene,
        "--robots-per-scene": robots_per_scene,
        "--split": split,
        "--seed": seed,
        "--settler": settler,
        "--renderer": renderer,
        "--noise": noise,
        "--config": config and config.expanduser().absolute(),
    }
    words = ["submit", label_source, *words_of(given), *job_options.words()]
    if job_options.detach and job_options.address != "local":
        return detach_job(words, out, job_options)  # its sources are paths on the cluster
    options = {
        "seed": seed,
        "split": split,
        **_candidate_options(candidates, candidates_per_scene),
        "candidates.robots_per_scene": robots_per_scene,
        "settle.engine": settler,
        "observation.renderer": renderer,
        "observation.noise.enabled": True if noise else None,
    }
    with opening(words, job_options) as began_s:
        if scenes_from is None:
            houses, objects = houses or "builtin", objects or "builtin"
            house_source, object_source = open_houses(houses), open_objects(objects)
            spec = specify(label_source, house_source, object_source, options, config, robot, perturb)
            world = assemble_world(spec, house_source, object_source, houses, objects)
            refuse_unusable_engines(spec, job_options.address)
            if _existing_layout(out) is None:
                _refuse_no_scene(world, houses)
            source_url, layout, schema_version = "", layout_of(spec, n), None
        else:
            of_scenes = {name: given[name] for name in _OF_SCENES}
            stored = open_stored_scenes(scenes_from, houses, objects, of_scenes)
            spec = specify_again(label_source, stored, config, robot, perturb)
            houses, objects = stored.houses, stored.objects
            world = open_world(spec, houses, objects)
            refuse_unusable_engines(spec, job_options.address)
            source_url, schema_version = stored.run.storage.url, stored.run.manifest.schema_version
            layout = _existing_layout(out) or layout_again(spec, stored, n)
            refuse_too_few(stored, layout, n)
        sources = {"houses": absolute_source(houses), "objects": absolute_source(objects)}
        sources |= {"n_houses": str(len(world.house_ids)), "n_objects": str(len(world.object_names))}
        if source_url:
            sources["scenes_from"] = source_url
        manifest = manifest_of(spec, layout, sources, schema_version)
        planned = _planned(out, manifest, n) if job_options.dry_run else None
        run = None
        if planned is None:
            run = Run.create_or_open(open_storage(out), manifest, n)
    if given["--houses"] is None and not source_url:
        Progress(job_options.json).say("note", {"note": _BUILTIN}, _BUILTIN)
    if planned is not None:
        return dry_run(out, [planned], job_options, began_s)
    assert run is not None
    if job_options.detach:
        return detach_job(words, out, job_options)
    job_run = JobRun(run, sources["houses"], sources["objects"], source_url)
    return start_job(
        run.storage, out, [job_run], job_options, began_s, [*words, *job_options.address_words()]
    )


def _planned(out: str, manifest: Manifest, n: int) -> PlannedRun:
    """The shards that the run at `out`, or a new one, lacks. InputError for another specification there."""
    sources = manifest.sources
    references = sources["houses"], sources["objects"], sources.get("scenes_from", "")
    run = _existing_run(out)
    if run is None:
        return PlannedRun(manifest, None, n, manifest.layout.shards_for(n), *references)
    refuse_other(run.storage.url, run.manifest, manifest)
    return planned_run(JobRun(run, *references), max(n, run.n))


def _existing_layout(out: str) -> Layout | None:
    """The layout of the run at `out`; None where there is none yet. InputError for merged runs."""
    run = _existing_run(out)
    return None if run is None else run.layout


def _existing_run(out: str) -> Run | None:
    """The run at `out`; None where there is none yet. InputError for merged runs."""
    try:
        storage = open_storage(out, probe=False, create=False)
    except InputError:
        return None  # nothing there, or an address that `open_storage` refuses
    if storage.exists(MERGED):
        fix = "Extend it with `datagen extend`, or choose another --out"
        raise InputError(out, "", "holds merged runs, each with its own specification", fix)
    return Run.open(storage) if storage.exists("manifest.json") else None


def _refuse_no_scene(world: World, houses: str) -> None:
    """Raise InputError, before anything is written, where a new run's first scene cannot be made."""
    try:
        generate_scene(world, 0, StageClock())
    except InputError as error:
        raise InputError("--houses", houses, f"no scene can be made: {error.problem}", error.fix) from error


def _candidate_options(kind: str | None, per_scene: int | str | None) -> dict[str, int | str | None]:
    """Fields of --candidates and --candidates-per-scene, by dotted name."""
    number = _per_scene(None if per_scene is None else str(per_scene))
    if kind == "grid":
        if number not in (None, "grid"):
            fix = "Give --candidates clear or in-range to sample some, or omit the number"
            raise InputError("--candidates-per-scene", str(per_scene), "a grid has all its cells", fix)
        number = "grid"
    elif kind is not None and number == "grid":
        problem = f"a whole grid has cells that are not {kind}"
        raise InputError("--candidates", kind, problem, "Give --candidates-per-scene 60")
    within = kind if kind != "grid" else None
    return {"candidates.per_scene": number, "candidates.within": within}


def _per_scene(text: str | None) -> int | str | None:
    if text is None or text == "grid":
        return text
    if not (text.isascii() and text.isdigit() and len(text) < 9) or not 1 <= int(text) <= 625:
        raise InputError(
            "--candidates-per-scene", text, "is neither grid nor a number from 1 to 625", "Give 60 or grid"
        )
    return int(text)
