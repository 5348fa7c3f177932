"""`datagen submit`: make labels. The same command on the same folder resumes the run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from typing_extensions import Unpack

from datagen.configuration.arms import refuse_missing_packages
from datagen.configuration.manifest import manifest_of
from datagen.configuration.specify import layout_of, specify
from datagen.configuration.stored_scenes import (
    layout_again,
    open_stored_scenes,
    refuse_too_few,
    specify_again,
)
from datagen.console.command_lines import words_of
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.jobs.detach import detach_job
from datagen.jobs.job import JobRun
from datagen.jobs.job_report import reported
from datagen.jobs.job_result import JobResult
from datagen.jobs.options import (
    HERE,
    JobKeywords,
    JobOptions,
    absolute_place,
    absolute_source,
    opening,
    refuse_odd_n,
)
from datagen.jobs.start_job import refuse_unusable_engines, start_job
from datagen.schemas.cost import StageClock
from datagen.schemas.errors import InputError
from datagen.schemas.keys import MERGED
from datagen.schemas.progress import Progress
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
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
_BUILTIN = (
    "Using built-in houses. For real ones: datagen assets fetch procthor-10k --out DIR, then "
    "--houses procthor:DIR/procthor"
)


def verb(
    label_source: Annotated[str, Parameter(name="LABEL_SOURCE", help="heuristic, plan or sim.")],
    /,
    *,
    n: Annotated[int, WHOLE_NUMBER, Parameter(help="Labels wanted; a larger number extends the run.")],
    out: Annotated[str, Parameter(help="Folder or s3:// address of the run.")],
    houses: Annotated[str | None, Parameter(help="builtin, procthor:DIR or ai2thor:DIR [builtin].")] = None,
    objects: Annotated[str | None, Parameter(help="builtin or ycb:DIR [builtin].")] = None,
    scenes_from: Annotated[
        str | None, Parameter(help="Run whose scenes and candidates are labelled again.")
    ] = None,
    robot: Annotated[
        str | None,
        Parameter(
            help="fetch, panda, panda-scaled or xarm7; sets reach and height [plan, sim: panda-scaled]."
        ),
    ] = None,
    perturb: Annotated[
        int | None,
        WHOLE_NUMBER,
        Parameter(help="Trials per candidate, each with random errors of pose and world (sim) [1, without]."),
    ] = None,
    candidates: Annotated[
        Literal["grid", "clear", "in-range"] | None,
        Parameter(
            help="Cells to sample from: all, those with a clear base, or those also within reach [grid]."
        ),
    ] = None,
    candidates_per_scene: Annotated[
        str | None,
        Parameter(help="Candidates sampled per scene from the 25x25 grid, or grid for all 625 [60]."),
    ] = None,
    robots_per_scene: Annotated[
        int | None,
        WHOLE_NUMBER,
        Parameter(help="Robots that share a scene's candidates [4; 1 on a whole grid]."),
    ] = None,
    split: Annotated[
        Literal["train", "val", "test", "all"] | None,
        Parameter(help="Split of the houses; splits share no house [all]."),
    ] = None,
    seed: Annotated[int | None, WHOLE_NUMBER, Parameter(help="Seed of the whole run [0].")] = None,
    settler: Annotated[
        str | None, Parameter(help="Physics engine: sapien or pybullet [sapien where installed].")
    ] = None,
    renderer: Annotated[str | None, Parameter(help="Renderer: embree, sapien or pybullet [embree].")] = None,
    noise: Annotated[bool, Parameter(negative=(), help="Add sensor noise to the frame.")] = False,
    config: Annotated[Path | None, Parameter(help="TOML file with any field of the specification.")] = None,
    job_options: JobOptions = HERE,
) -> int:
    """Make labels: start a run, or resume the run in the folder.

    The same command on the same folder resumes the run, and a larger --n extends it; other options are
    refused with the fields that differ. Ctrl-C finishes the running attempts, a second Ctrl-C stops at once;
    committed shards are kept.

    For example: datagen submit heuristic --n 1e5 --out runs/first
    """
    return reported(
        lambda: submit(
            label_source,
            n=n,
            out=out,
            houses=houses,
            objects=objects,
            scenes_from=scenes_from,
            robot=robot,
            perturb=perturb,
            candidates=candidates,
            candidates_per_scene=candidates_per_scene,
            robots_per_scene=robots_per_scene,
            split=split,
            seed=seed,
            settler=settler,
            renderer=renderer,
            noise=noise,
            config=config,
            job_options=job_options,
        )
    )


def submit(
    label_source: str,
    *,
    n: int,
    out: str | Path,
    houses: str | None = None,
    objects: str | None = None,
    scenes_from: str | Path | None = None,
    robot: str | None = None,
    perturb: int | None = None,
    candidates: Literal["grid", "clear", "in-range"] | None = None,
    candidates_per_scene: int | str | None = None,
    robots_per_scene: int | None = None,
    split: Literal["train", "val", "test", "all"] | None = None,
    seed: int | None = None,
    settler: str | None = None,
    renderer: str | None = None,
    noise: bool = False,
    config: str | Path | None = None,
    job_options: JobOptions | None = None,
    **where: Unpack[JobKeywords],
) -> JobResult:
    """Make labels and return what was done: start a run, or continue the one in the folder.

    The call blocks and reports progress on standard error; in a notebook an interrupt of the kernel lets
    the shards in flight finish, and the same call, or `resume`, continues. Options are those of
    `datagen submit`, which `datagen submit --help` describes; the same options make the same bytes for
    any number of workers.

    Args:
        label_source: One of `datagen.label_sources`: heuristic, plan or sim.
        n: Labels wanted; a larger number later extends the run.
        out: The run's folder or s3:// address.
        houses: One of `datagen.houses`, as `procthor:DIR` [builtin].
        objects: One of `datagen.objects`, as `ycb:DIR` [builtin].
        scenes_from: A run whose scenes and candidates are labelled again.
        robot: One of `datagen.robots` [plan, sim: panda-scaled].
        perturb: Trials at each candidate under disturbances (sim) [undisturbed].
        candidates: Which cells of the grid around the target are candidates.
        candidates_per_scene: Candidates of a scene [60]; "grid" for all 625.
        robots_per_scene: Robots that share a scene's candidates [4, and 1 on a whole grid].
        split: Houses to use, disjoint by split [all].
        seed: Seed of the whole run [0].
        settler: Physics engine: sapien or pybullet.
        renderer: Renderer of the RGB-D frame: embree, sapien or pybullet [embree].
        noise: Add the sensor noise model to the frame.
        config: TOML file with any field of the specification.
        job_options: What the command line gives instead of `where`.
        where: `workers` (processes [one a core]; 0 works in this process), `address` (of a Ray cluster
            [local]), `max_quarantined` (share of shards that may fail [0.01]), `detach` (let Ray continue
            when this process ends) and `quiet` (report no progress).

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
    out, job_options = str(out), job_options or JobOptions(**where)
    scenes_from = None if scenes_from is None else str(scenes_from)
    config = None if config is None else Path(config)
    refuse_missing_packages(label_source)
    load_label_source(label_source)  # InputError for an unknown one
    refuse_odd_n(n)
    job_options.refuse_bad()
    said = {
        "--n": n,
        "--out": absolute_place(out),
        "--houses": houses and absolute_source(houses),
        "--objects": objects and absolute_source(objects),
        "--scenes-from": scenes_from and absolute_place(scenes_from),
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
    words = ["submit", label_source, *words_of(said), *job_options.words()]
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
            if _layout_there(out) is None:
                _refuse_no_scene(world, houses)
            source_url, layout, schema_version = "", layout_of(spec, n), None
        else:
            stored = open_stored_scenes(
                scenes_from, houses, objects, {name: said[name] for name in _OF_SCENES}
            )
            spec = specify_again(label_source, stored, config, robot, perturb)
            houses, objects = stored.houses, stored.objects
            world = open_world(spec, houses, objects)
            refuse_unusable_engines(spec, job_options.address)
            source_url, layout = stored.run.storage.url, _layout_there(out) or layout_again(spec, stored, n)
            schema_version = stored.run.manifest.schema_version
            refuse_too_few(stored, layout, n)
        sources = {"houses": absolute_source(houses), "objects": absolute_source(objects)}
        sources |= {"n_houses": str(len(world.house_ids)), "n_objects": str(len(world.object_names))}
        if source_url:
            sources["scenes_from"] = source_url
        manifest = manifest_of(spec, layout, sources, schema_version)
        run = Run.create_or_open(open_storage(out), manifest, n)
    if said["--houses"] is None and not source_url:
        Progress(job_options.json).say("note", {"note": _BUILTIN}, _BUILTIN)
    if job_options.detach:
        return detach_job(words, out, job_options)
    job_run = JobRun(run, sources["houses"], sources["objects"], source_url)
    return start_job(
        run.storage, out, [job_run], job_options, began_s, [*words, *job_options.address_words()]
    )


def _layout_there(out: str) -> Layout | None:
    """The layout of the run at `out`; None where there is none yet. InputError for merged runs."""
    try:
        storage = open_storage(out, probe=False, create=False)
    except InputError:
        return None  # nothing there, or an address that `open_storage` refuses
    if storage.exists(MERGED):
        fix = "Extend it with `datagen extend`, or choose another --out"
        raise InputError(out, "", "holds merged runs, each with its own specification", fix)
    return Run.open(storage).layout if storage.exists("manifest.json") else None


def _refuse_no_scene(world: World, houses: str) -> None:
    """Sample a new run's first scene: InputError, before anything is written, where no scene can be made."""
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
        problem = f"a whole grid has other cells than {kind} ones"
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
