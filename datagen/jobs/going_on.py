"""What `submit`, `resume` and `extend` share: an existing run's sources opened, and its job begun."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError

from datagen.console.command_lines import resumable, words_of
from datagen.doctor.engines import probe_render_device
from datagen.jobs.detach import detach_job, detached_words
from datagen.jobs.job import JobPlan, Work, carry_out
from datagen.jobs.options import Placing, absolute_place, absolute_source, opening
from datagen.remaking.shards import open_origin
from datagen.remaking.sources import AS_FOUND, Sources
from datagen.schemas.errors import InputError
from datagen.schemas.merged import open_runs
from datagen.schemas.record_files import different_fields
from datagen.schemas.run import Run
from datagen.schemas.specification import Specification
from datagen.schemas.storage import Storage, open_storage
from datagen.specifying.arms import refuse_missing_packages
from datagen.specifying.specify import label_engines, scene_engines
from datagen.workers.labels import load_label_source
from datagen.workers.robots import gripper_of


def source_words(given: Sources) -> list[str]:
    """The options that say the same again, from any folder."""
    return words_of(
        {
            "--houses": given.houses and absolute_source(given.houses),
            "--objects": given.objects and absolute_source(given.objects),
            "--scenes-from": given.scenes_from and absolute_place(given.scenes_from),
        }
    )


def open_work(run: Run, given: Sources, address: str) -> Work:
    """An existing run with its sources, checked to be those that it was made from.

    InputError where they are not there, or where another engine is installed than the run was made with:
    its shards would then be of another kind than those that are there.
    """
    spec, known = run.manifest.spec, run.manifest.sources
    refuse_missing_packages(spec.label_source)
    load_label_source(spec.label_source)
    _ = run.schema  # refuses a run of another schema version
    if given.scenes_from is not None and spec.scenes_from is None:
        problem = f"{run.storage.url} draws its own scenes"
        raise InputError("--scenes-from", given.scenes_from, problem, "Take --scenes-from out")
    _refuse_other_engines(run)
    open_origin(run, given)
    refuse_unusable_engines(spec, address)
    return Work(
        run,
        absolute_source(given.houses or known.get("houses", "builtin")),
        absolute_source(given.objects or known.get("objects", "builtin")),
        "" if spec.scenes_from is None else absolute_place(given.scenes_from or known["scenes_from"]),
    )


def continue_job(
    words: Sequence[str],
    name: str,
    given: Sources,
    placing: Placing,
    prepare: Callable[[Sequence[Work]], None],
) -> int:
    """Open what is at `name`, let `prepare` change it, and make what is missing; the exit code.

    `words` are those of the command itself: a detached job is given them, and repeats `prepare`.
    """
    if placing.detach and placing.address != "local":
        return detach_job(words, name, placing)
    with opening(words, placing) as began_s:
        place = open_storage(name, create=False)
        works = [open_work(run, given, placing.address) for run in open_runs(place)]
        prepare(works)
    if placing.detach:
        return detach_job(words, name, placing)
    return go_on(place, name, works, placing, began_s, given)


def go_on(
    place: Storage,
    name: str,
    works: Sequence[Work],
    placing: Placing,
    began_s: float,
    given: Sources = AS_FOUND,
) -> int:
    """Run the job of what is missing; the exit code. `name` is the place as the user wrote it."""
    words = ["resume", absolute_place(name), *source_words(given), *placing.words()]
    words += detached_words() or placing.address_words()
    with resumable(words):
        return carry_out(JobPlan(place, name, works, placing, began_s, words))


def refuse_unusable_engines(spec: Specification, address: str) -> None:
    """Raise InputError for a robot or a renderer with which every shard would fail."""
    if spec.arm is not None:
        gripper_of(spec.arm.robot)
    if address == "local" and spec.scenes_from is None and spec.observation.renderer == "sapien":
        device = probe_render_device()
        if not device.succeeded:
            problem, mend = f"no render device here ({device.text})", "Take embree, or see `datagen doctor`"
            raise InputError("--renderer", "sapien", problem, mend)


def _refuse_other_engines(run: Run) -> None:
    spec = run.manifest.spec
    try:
        here = label_engines(spec.label_source)
        if spec.scenes_from is None:  # stored scenes are what they are, whatever drew them
            here |= scene_engines(spec)
    except PackageNotFoundError as error:
        raise InputError(
            run.storage.url, "engines", f"{error.name} is not installed here", "Install it"
        ) from None
    made = {name: version for name, version in spec.engines.items() if name in here}
    rows = [f"{name}: it has {a}, here is {b}" for name, a, b in different_fields(made, here)]
    if rows:
        place, mend = f"{run.storage.url}/manifest.json", "Install what it has, or start a new run"
        raise InputError(place, "engines", "; ".join(rows), mend)
