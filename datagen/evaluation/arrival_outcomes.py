"""Arrivals in one scene: planned, executed, and kept in a file, so that each is done once.

An arrival is identified by candidate, error, and the world that it is executed in. Its outcome depends on
nothing else, so methods with the same pick share it, and no order or number of processes changes it.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from datagen.cluster.ray_settings import changed_environment
from datagen.display.progress import counting
from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.identity import Stream, digest_of, generator
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.safe_files import read_regular, whole_file
from datagen.schemas.shard_reading import read_scene
from datagen.schemas.specification import Specification
from datagen.workers.engine_versions import label_engines
from datagen.workers.labels.arm_labelling import arm_in_scene, draw_disturbances
from datagen.workers.labels.arrival_trial import arrival_specification, try_arrival
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from datagen.workers.world import World, open_world

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

Stopping = Callable[[], bool]
# Raise it when the same arrival would have another outcome for a reason that `engines` does not name.
_VERSION = 2
_MOST_BYTES = 64 << 20
_WORLD = 2  # purposes 0 and 1 of a scene's generators are picks and arrivals
PLAN, SIM = "plan", "sim"
_POLL_S = 0.2
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_stop: Event | None = None  # set in the processes that make_all starts


class Arrived(NamedTuple):
    """Where a robot that was sent to a candidate arrived."""

    candidate: int
    x_m: float
    y_m: float
    yaw_rad: float

    @property
    def key(self) -> str:
        """The key of its outcome in the file of the scene."""
        return f"{self.candidate} {self.x_m:.6f} {self.y_m:.6f} {self.yaw_rad:.6f}"


@dataclass(frozen=True)
class SceneTask:
    """The arrivals wanted in scene `scene` of a run, with plans alone or in physics."""

    run: str
    spec: Specification
    houses: str
    objects: str
    robot: str
    scene: int
    mode: str
    seed: int
    folder: str
    arrivals: tuple[Arrived, ...]

    @cached_property
    def path(self) -> Path:
        """The file of outcomes, named after all that decides them except the arrivals."""
        arm = arrival_specification(self.spec, self.mode == SIM).arm
        assert arm is not None
        key = {
            "version": _VERSION,
            "spec": self.spec.hash(),
            "scene": self.scene,
            "arm": arm.model_dump(mode="json"),
            "seed": self.seed if self.mode == SIM else None,
            "engines": label_engines(self.mode),
        }
        return Path(self.folder, f"{digest_of(key)}.json")

    def missing(self) -> list[Arrived]:
        """The arrivals without an outcome. InputError where the file is damaged."""
        known = read_outcomes(self.path)
        return [arrived for arrived in self.arrivals if arrived.key not in known]


def scene_generator(seed: int, spec_hash: str, scene: int, purpose: int) -> np.random.Generator:
    """The generator of a closed loop for one scene: of picks, arrivals or the world."""
    return generator(seed, Stream.ARRIVAL, int(spec_hash[:16], 16), scene, purpose)


def read_outcomes(path: Path) -> dict[str, str]:
    """The outcomes by key of `Arrived`; none without a file. InputError where it is damaged."""
    if not path.exists():
        return {}
    fix = "Remove this file; its arrivals are made again"
    data = read_regular(path, _MOST_BYTES, fix)
    try:
        known = json.loads(data)["outcomes"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(path, "outcomes", f"is damaged ({error!s:.100})", fix) from error
    if not isinstance(known, dict) or any(outcome not in OUTCOMES for outcome in known.values()):
        raise InputError(path, "outcomes", "has an unknown outcome", fix)
    return known


def make_all(tasks: Sequence[SceneTask], workers: int, stopping: Stopping, json: bool) -> bool:
    """Make the missing outcomes of all scenes in `workers` processes (0: in this one); False where stopped.

    Errors of a process are raised here; InputError where one ended without a message.
    """
    todo = [task for task in tasks if task.missing()]
    with counting("scenes of the closed loop", json) as seen:
        if not workers:
            for k, task in enumerate(todo):
                if not make_arrivals(task, stopping):
                    return False
                seen(k + 1, len(todo))
            return True
        context = multiprocessing.get_context("spawn")
        stop = context.Event()
        ended: list[bool] = []
        # Libraries read the number of threads when they are loaded.
        with (
            changed_environment(dict.fromkeys(_THREADS, "1")),
            ProcessPoolExecutor(min(workers, len(todo)) or 1, context, _begin, (stop,)) as pool,
        ):
            pending = {pool.submit(_make, task) for task in todo}
            try:
                while pending and not stopping():
                    done, pending = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                    ended += [future.result() for future in done]
                    seen(len(ended), len(todo))
            except BrokenProcessPool:
                fix = "Run the same command to resume, with fewer --workers if memory was short"
                raise InputError(
                    "--workers", str(workers), "a process ended without a message", fix
                ) from None
            finally:
                stop.set()
                for future in pending:
                    future.cancel()
        return len(ended) == len(todo) and all(ended)


def _begin(stop: Event) -> None:
    """Set up a process. Ctrl-C reaches the whole group, and only the first process handles it."""
    global _stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _stop = stop


def _make(task: SceneTask) -> bool:
    parent, stop = multiprocessing.parent_process(), _stop
    assert parent is not None and stop is not None
    return make_arrivals(task, lambda: stop.is_set() or not parent.is_alive())


def make_arrivals(task: SceneTask, stopping: Stopping) -> bool:
    """Make the outcomes that are missing and write the file; False where it was stopped before the last."""
    missing = task.missing()
    if stopping() or not missing:
        return not missing
    run, world = _opened(task.run, task.spec.hash(), task.houses, task.objects, task.robot)
    spec = arrival_specification(task.spec, task.mode == SIM)
    stored = read_scene(run, task.scene)
    scene = reconstruct_scene(world, stored.record)
    candidates = reconstruct_candidates(stored.samples, scene)
    at = arm_in_scene(scene, candidates, 0, spec, StageClock())
    in_world = None
    if spec.arm is not None and spec.arm.disturbance is not None:
        once = spec.arm.disturbance.model_copy(update={"repeats": 1})
        rng = scene_generator(task.seed, task.spec.hash(), task.scene, _WORLD)
        (in_world,) = draw_disturbances(once, scene.T_world_object[0], rng)
    outcomes = read_outcomes(task.path)
    try:
        for arrived in missing:
            if stopping():
                return False
            offset = (arrived.x_m, arrived.y_m, arrived.yaw_rad)
            outcomes[arrived.key] = try_arrival(at, candidates, arrived.candidate, offset, in_world, spec)
    finally:
        with whole_file(task.path) as file:
            file.write(json.dumps({"outcomes": dict(sorted(outcomes.items()))}, indent=0).encode())
    return True


@lru_cache(maxsize=1)
def _opened(path: str, spec_hash: str, houses: str, objects: str, robot: str) -> tuple[Run, World]:
    run = Run.open(path)
    if run.manifest.spec_hash != spec_hash:
        raise InputError(path, "spec_hash", "the run now has another specification", "Start it again")
    return run, open_world(run.manifest.spec, houses, objects, robot)
