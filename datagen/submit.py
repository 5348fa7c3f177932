"""`datagen submit`: make labels. The same command on the same folder resumes."""

from __future__ import annotations

import os
import platform
import shlex
import sys
import tempfile
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from cluster.attempt import run_attempt
from cluster.books import RunBooks, close_lost_attempts
from cluster.driver import Order, drive
from cluster.executor import Executor
from cluster.inprocess import InProcessExecutor
from cluster.policy import Policy, too_many_quarantined
from cluster.progress import progress
from cluster.ray_executor import RayExecutor, RaySettings, ray_cluster, refuse_unreachable
from cluster.stop import StopRequest, stop_on_signals
from cluster.tally import JobSummary, Tally
from cluster.task import ShardTask
from datagen import __version__
from datagen.console import print_rows, seconds
from datagen.doctor.engines import probe_render_device
from datagen.specify import layout_of, specify
from datagen.whole_number import WHOLE_NUMBER
from schemas.cost import StageClock
from schemas.errors import InputError
from schemas.fields import SCHEMAS
from schemas.record_files import now
from schemas.run import Run
from schemas.run_records import Manifest
from schemas.seal import seal
from schemas.specification import Specification
from schemas.storage import open_storage
from workers.houses import open_houses
from workers.labels import load_label_source
from workers.objects import open_objects
from workers.scenes.draw import draw_scene
from workers.world import World, assemble_world

_LIBRARIES = ("numpy", "scipy", "embreex", "sapien", "pybullet", "zarr", "obstore", "ray", "trimesh")


def submit(
    label_source: Annotated[str, Parameter(help="How candidates are labelled: heuristic.")],
    /,
    *,
    n: Annotated[int, WHOLE_NUMBER, Parameter(help="Labels wanted; a larger number later extends the run.")],
    out: Annotated[str, Parameter(help="The run's folder.")],
    houses: Annotated[str, Parameter(help="builtin, procthor:DIR or ai2thor:DIR.")] = "builtin",
    objects: Annotated[str, Parameter(help="builtin or ycb:DIR.")] = "builtin",
    candidates_per_scene: Annotated[
        str | None, Parameter(help="60 drawn from the 25x25 grid, another number, or grid for all 625.")
    ] = None,
    robots_per_scene: Annotated[
        int | None,
        WHOLE_NUMBER,
        Parameter(help="Robots the candidates are dealt out to: 4, and 1 on a whole grid."),
    ] = None,
    split: Annotated[
        Literal["train", "val", "test", "all"] | None,
        Parameter(help="Houses to use, disjoint by split [all]."),
    ] = None,
    seed: Annotated[int | None, WHOLE_NUMBER, Parameter(help="Seed of the whole run [0].")] = None,
    settler: Annotated[
        str | None, Parameter(help="Physics: sapien, or pybullet [sapien, or what can be imported].")
    ] = None,
    renderer: Annotated[
        str | None, Parameter(help="Renderer of the RGB-D frame: embree, sapien or pybullet [embree].")
    ] = None,
    noise: Annotated[bool, Parameter(negative=(), help="Add the sensor noise model to the frame.")] = False,
    config: Annotated[Path | None, Parameter(help="TOML file with any field of the specification.")] = None,
    workers: Annotated[
        int | None,
        WHOLE_NUMBER,
        Parameter(help="Worker processes [one a core]; 0 works in this process, for debuggers."),
    ] = None,
    address: Annotated[str, Parameter(help="local, or the address of a running Ray cluster.")] = "local",
    json: Annotated[
        bool, Parameter(negative=(), help="Report progress as JSON lines, also on a terminal.")
    ] = False,
) -> int:
    """Make labels: start a run, or go on with the one that is in the folder.

    Submitting the same specification to the same folder resumes it; a larger --n extends it; another
    specification is refused with the fields that differ. Ctrl-C once finishes what is in flight,
    twice ends it at once; nothing that is committed is lost.
    """
    load_label_source(label_source)  # refuses an unknown one
    if not 1 <= n <= 10**12:
        raise InputError("--n", str(n), "is not between 1 and 10^12", "Say how many labels you want")
    if workers is not None and not 0 <= workers <= 4096:
        raise InputError(
            "--workers", str(workers), "is not between 0 and 4096", "Leave it out for one a core"
        )
    if workers != 0:
        refuse_unreachable(address)
    per_scene = _per_scene(candidates_per_scene)
    options = {
        "seed": seed,
        "split": split,
        "candidates.per_scene": per_scene,
        "candidates.robots_per_scene": robots_per_scene,
        "settle.engine": settler,
        "observation.renderer": renderer,
        "observation.noise.enabled": True if noise else None,
    }
    house_source, object_source = open_houses(houses), open_objects(objects)
    spec = specify(label_source, house_source, object_source, options, config)
    world = assemble_world(spec, house_source, object_source, houses, objects)
    if address == "local" and spec.observation.renderer == "sapien":
        _refuse_no_render_device()
    if not (Path(out) / "manifest.json").exists():
        _refuse_no_scene(world, houses)
    manifest = manifest_of(spec, n, {"houses": _absolute(houses), "objects": _absolute(objects)})
    run = Run.create_or_open(open_storage(out), manifest, n)
    settings = JobSettings(_absolute(houses), _absolute(objects), workers, address, json)
    summary = run_job(run, settings)
    return finish(run, summary, out)


def _refuse_no_scene(world: World, houses: str) -> None:
    """Draw a new run's first scene here: sources that give none are refused before anything is written."""
    try:
        draw_scene(world, 0, StageClock())
    except InputError as error:
        raise InputError("--houses", houses, f"gives no scene: {error.problem}", error.mend) from error


@dataclass(frozen=True)
class JobSettings:
    """Where a job runs and finds its sources; nothing of this changes a sample."""

    houses: str
    objects: str
    workers: int | None
    address: str
    json: bool


def manifest_of(spec: Specification, n: int, sources: dict[str, str]) -> Manifest:
    """The manifest of a new run of n labels."""
    source = load_label_source(spec.label_source)
    return Manifest(
        spec=spec,
        spec_hash=spec.hash(),
        schema_name=source.schema,
        schema_version=SCHEMAS[source.schema].version,
        layout=layout_of(spec, n),
        code_version=__version__,
        libraries={name: version(name) for name in _LIBRARIES},
        platform=platform.platform(),
        created=now(),
        sources=sources,
    )


def run_job(run: Run, settings: JobSettings) -> JobSummary:
    """Make every missing shard of the run, here or on a Ray cluster."""
    missing = run.missing()
    layout, spec = run.layout, run.manifest.spec
    done = len(run.planned()) - len(missing)
    if not missing:
        close_lost_attempts(run)
        given_up, shards = run.quarantined() & set(run.planned()), len(run.planned())
        failed = too_many_quarantined(Policy(), len(given_up), shards)
        return JobSummary("failed" if failed else "complete", "", Tally(0), 0.0)
    stop = StopRequest()
    with ExitStack() as stack:
        # Local paths travel to workers of this machine; on a cluster they are shared by all nodes.
        notes = stack.enter_context(tempfile.TemporaryDirectory(prefix="datagen-notes-"))

        def make_task(order: Order) -> ShardTask:
            return ShardTask(
                run=run.storage.url,
                spec=spec,
                layout=layout,
                shard=order.shard,
                attempt=order.attempt,
                houses=settings.houses,
                objects=settings.objects,
                deadline_s=order.deadline_s,
                memory_factor=order.memory_factor,
                notes=notes,
            )

        executor = _executor(settings, len(missing), stack)
        stack.enter_context(stop_on_signals(stop, interrupt=settings.workers == 0))
        display = stack.enter_context(
            progress(layout.samples_per_shard, len(missing), done, True if settings.json else None)
        )
        summary = drive(missing, make_task, executor, RunBooks(run), Policy(), display, stop)
    # What a killed driver left open is closed last: its workers may outlive it and still commit.
    close_lost_attempts(run)
    return summary


def _executor(settings: JobSettings, shards: int, stack: ExitStack) -> Executor[ShardTask]:
    if settings.workers == 0:
        return InProcessExecutor(run_attempt)
    cores = len(os.sched_getaffinity(0))
    workers = min(settings.workers or cores, shards)  # Ray starts them all at once
    ray_settings = RaySettings(address=settings.address, workers=workers)
    return RayExecutor(run_attempt, ray_settings, stack.enter_context(ray_cluster(ray_settings)))


def finish(run: Run, summary: JobSummary, out: str) -> int:
    """Seal what there is, say how it went and how to go on; return the exit code."""
    tally = summary.tally
    n, given_up = run.n, sorted(run.quarantined())
    if tally.shards:
        labels = f"{tally.labels:,} new, {n:,} wanted"
    elif given_up:
        labels = f"nothing to do: the shards of {n:,} labels are made or given up"
    else:
        labels = f"nothing to do: all {n:,} labels are there"
    rows = [
        ("labels", labels),
        ("positive", f"{100 * tally.positives / tally.labels:.1f}%" if tally.labels else "-"),
        ("time", f"{seconds(summary.elapsed_s)}" + _rate(summary)),
        ("retries", str(tally.retries)),
    ]
    if given_up:
        shown = (
            f"{len(given_up)} shards, {given_up[:10]}: remove {shlex.quote(f'{out}/quarantine')} to try again"
        )
        rows.append(("quarantined", shown))
    if summary.end in ("complete", "failed") and run.committed():
        sealed = seal(run)
        rows.append(("store", f"{sealed}: zarr.open or xarray.open_zarr reads it"))
    print_rows(f"{summary.end}: {out}", rows)
    if summary.end == "aborted":
        raise InputError(
            out, "", f"the job cannot go on: {summary.cause}", f"Then resume: {resume_command()}"
        )
    if summary.end == "failed":
        causes = Counter(record.causes[-1] for record in run.quarantine_records() if record.causes)
        most = f", most often by: {causes.most_common(1)[0][0]}" if causes else ""
        sys.stderr.write(
            f"error: {out}: too many shards failed{most}. See: datagen status {shlex.quote(out)}\n"
        )
    if summary.end == "interrupted":
        sys.stderr.write(
            f"interrupted with {summary.remaining} shards to go. Resume with:\n  {resume_command()}\n"
        )
    return summary.exit_code


def resume_command() -> str:
    """The command line that goes on with this run: the one that began it."""
    return shlex.join(["datagen", *sys.argv[1:]])


def _rate(summary: JobSummary) -> str:
    if not summary.tally.labels or summary.elapsed_s <= 0:
        return ""
    return f", {summary.tally.labels / summary.elapsed_s:,.0f} labels/s"


def _refuse_no_render_device() -> None:
    """Every scene would fail, and a run of another renderer is another run: better now."""
    device = probe_render_device()
    if not device.succeeded:
        raise InputError(
            "--renderer",
            "sapien",
            f"no render device here ({device.text})",
            "Take embree, or see `datagen doctor`",
        )


def _per_scene(text: str | None) -> int | str | None:
    if text is None or text == "grid":
        return text
    if not (text.isascii() and text.isdigit() and len(text) < 9) or not 1 <= int(text) <= 625:
        raise InputError(
            "--candidates-per-scene", text, "is neither grid nor a number from 1 to 625", "Give 60, or grid"
        )
    return int(text)


def _absolute(ref: str) -> str:
    """A source reference with its file or folder made absolute: workers run elsewhere."""
    kind, _, text = ref.partition(":")
    # What names no file is a parameter of the source, as in builtin:400.
    is_path = bool(text) and kind != "builtin" and Path(text).expanduser().exists()
    return f"{kind}:{Path(text).expanduser().resolve()}" if is_path else ref
