"""One attempt of one shard, from its task to its commit. Runs in a worker, independent of Ray."""

from __future__ import annotations

import secrets
from collections.abc import Generator
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import Any, Literal

import numpy.typing as npt

from datagen.cluster.attempt_guard import Meter, this_host
from datagen.cluster.protocol import (
    AttemptOrder,
    AttemptResult,
    JobCannotContinue,
    ShardTask,
    UnfitMachine,
    code_digest,
)
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import commit_key, utc_now
from datagen.schemas.run import Run, RunReplaced
from datagen.schemas.run_records import Commit, StageClock
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.shard_reading import read_scenes
from datagen.schemas.storage.errors import FORBIDDEN, FULL, StoreUnavailable, machine_error
from datagen.workers.engine_versions import refuse_other_engines
from datagen.workers.robots import gripper_of
from datagen.workers.run_shard import run_shard
from datagen.workers.world import World, open_world


def run_attempt(task: ShardTask, meter: Meter) -> AttemptResult:
    """Compute the shard's arrays, write them, and commit them unless another attempt was first.

    Raises JobCannotContinue where run or sources cannot be opened, or the disk is full. Other exceptions
    are not caught and concern this attempt only (see `guarded`).
    """
    run, world, scenes_run = open_task(task)
    with ends_job():
        run.ledger.start(task.attempt, task.shard)
        if task.may_be_done and run.storage.exists(commit_key(task.shard)):
            return AttemptResult(False, 0, 0, meter.cost())
    stored = None if scenes_run is None else list(read_scenes(scenes_run, task.scene_indices))
    made = run_shard(task.spec, world, task.scene_indices, stored, meter.watch)
    with ends_job(), made.clock.stage("write"):
        # A run of an older version keeps its arrays.
        scene = {field.name: made.scene[field.name] for field in run.schema.scene_fields}
        sample = {field.name: made.sample[field.name] for field in run.schema.sample_fields}
        data = encode_shard(run.schema, run.layout, run.manifest.spec_hash, scene, sample)
    return commit_rows(run, task, data, made.sample["label"], made.clock, meter, made.redraws)


def commit_rows(
    run: Run,
    task: AttemptOrder,
    data: bytes,
    labels: npt.NDArray[Any],
    clock: StageClock,
    meter: Meter,
    redraws: dict[str, int],
    source_s: dict[Literal["wall", "cpu"], float] | None = None,
) -> AttemptResult:
    """Write the rows of a shard, with these labels (N,), and commit them unless another attempt was first.

    Raises JobCannotContinue for a full or read-only disk.
    """
    with ends_job(), clock.stage("write"):
        entry = run.write_object(task.attempt, data)
    cost = meter.cost(clock, entry.size).model_copy(update={"source_s": source_s or {}})
    commit = Commit(
        shard=task.shard,
        attempt=task.attempt,
        spec_hash=run.manifest.spec_hash,
        scenes=run.layout.scenes_per_shard,
        samples=len(labels),
        positives=int(labels.sum()),
        redraws=redraws,
        object=entry,
        cost=cost,
        host=this_host(),
        code_digest=code_digest(),
        created=utc_now(),
    )
    with ends_job():
        won = run.commit(commit)
    return AttemptResult(won, len(labels), commit.positives, cost, commit if won else None)


def open_task(task: ShardTask) -> tuple[Run, World, Run | None]:
    """Open the run, the world of its sources, and the run whose scenes are labelled again, if any.

    They are opened, and this machine is checked, once per process. Raises UnfitMachine where that fails.
    """
    with ends_job(every_input_error=True):
        refuse_other_code(task.code_digest)
        run, world = _open(task.run, task.spec.hash(), task.houses, task.objects, task.robot, task.probe)
        stored = task.spec.scenes_from
        scenes_run = None if stored is None else _open_scenes_run(task.scenes_from, stored.spec_hash)
    return run, world, scenes_run


@contextmanager
def ends_job(every_input_error: bool = False) -> Generator[None]:
    """Raise JobCannotContinue for a full disk or a replaced run, and UnfitMachine for a read-only one.

    Optionally also UnfitMachine for any InputError, except from a store that does not respond.
    """
    try:
        yield
    except StoreUnavailable:
        raise
    except RunReplaced as error:
        raise JobCannotContinue(str(error)) from error
    except (InputError, OSError) as error:
        if (full := machine_error(error, FULL)) is not None:
            raise JobCannotContinue(str(full)) from error
        forbidden = machine_error(error, FORBIDDEN)
        if forbidden is None and not (every_input_error and isinstance(error, InputError)):
            raise
        raise UnfitMachine(str(forbidden or error)) from error


@lru_cache(maxsize=1)  # a worker serves one run at a time, and a world is large
def _open(path: str, spec_hash: str, houses: str, objects: str, robot: str, probe: str) -> tuple[Run, World]:
    run = Run.open(path)
    if run.manifest.spec_hash != spec_hash:
        raise InputError(path, "spec_hash", "the run now has another specification", "Submit to a new --out")
    refuse_unfit_machine(run, probe)
    world, arm = open_world(run.manifest.spec, houses, objects, robot), run.manifest.spec.arm
    if arm is not None:
        gripper_of(arm.robot_key)  # broken robot files concern every shard
    return run, world


@lru_cache(maxsize=1)
def _open_scenes_run(path: str, scenes_hash: str) -> Run:
    scenes_run = Run.open(path)
    if scenes_run.manifest.spec.scenes_hash != scenes_hash:
        fix = "Give --scenes-from with the run that this one was started with"
        raise InputError(path, "spec_hash", "the run now has other scenes", fix)
    return scenes_run


_SAME_CODE = "Install the same version of datagen on every machine"
_SHARED = "Put the run and its sources on a path that every machine has, or on s3://"


@contextmanager
def probe_in(run: Run) -> Generator[str]:
    """Give the name of a new file in the run, by which machines recognize it; removed after the block."""
    probe = f".probe-{secrets.token_hex(8)}"
    run.storage.put_new(probe, b"driver")
    try:
        yield probe
    finally:
        with suppress(InputError):
            run.storage.delete([probe])


def refuse_other_code(driver: str) -> None:
    """Raise InputError where this machine's code has another digest than the driver's."""
    if code_digest() != driver:
        raise InputError("datagen", "", "the code here differs from that of the job's driver", _SAME_CODE)


def refuse_unfit_machine(run: Run, probe: str) -> None:
    """Raise InputError where `run` is another folder than the driver's, or the engines here are others."""
    if probe and not run.storage.exists(probe):
        raise InputError(run.storage.url, "", "is another folder here than on the driver's machine", _SHARED)
    refuse_other_engines(f"{run.storage.url}/manifest.json", run.manifest.spec)
