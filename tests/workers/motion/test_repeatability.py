"""The same plans to the bit: in another process, in another order, through a search with random samples."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.motion import PlanReport
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.motion.planning_scene import PlanningScene
from datagen.workers.scenes import SettledScene
from tests.workers.motion.plan_checks import SceneJudge
from tests.workers.motion.tables import PARAMS, arm, box_grasps, digest, front_base, prepared, table_scene
from tests.workers.worlds import ROOM_M, box_body

REPOSITORY = Path(__file__).resolve().parents[3]
# Distances sideways and forward of bases; from most of them, poses near a grasp have plans that it lacks.
PLACES = ((0.2, 0.6), (0.0, 0.6), (-0.2, 0.45), (0.3, 0.75), (0.0, 0.7))
SEARCHED = PARAMS.model_copy(update={"nearby_rounds": 2, "lift_m": 0.15})


def barred_scene() -> SettledScene:
    """A bar across the room between bases and the table, at the height where straight paths pass."""
    bar = box_body("bar", "furniture", "Shelf", (1.2, 0.03, 0.03), (ROOM_M[0] / 2, 1.02, 1.15))
    return table_scene([bar])


def plan_at(scene: PlanningScene, place: int, rng: np.random.Generator) -> PlanReport:
    dx_m, away_m = PLACES[place]
    return plan_candidate(scene, front_base(barred_scene(), dx_m=dx_m, away_m=away_m), rng)


def held(T_object_tcp: F64, opening_m: float) -> float:
    return 1.0


def digests(order: list[int]) -> dict[tuple[int, bool], str]:
    """Reports by place: with all grasps, and with one and the poses near it."""
    every = box_grasps()
    one = GraspSet(every.T_object_tcp[6:7], every.opening_m[6:7], every.score[6:7], 0.5, None, held)
    scenes = prepared(barred_scene()), prepared(barred_scene(), grasps=one, params=SEARCHED)
    return {
        (k, near): digest(plan_at(scenes[near], k, np.random.default_rng([7, k])))
        for k in order
        for near in (False, True)
    }


def test_a_search_was_needed_and_its_path_is_free() -> None:
    scene = barred_scene()
    ready, searched = prepared(scene), 0
    for k, (dx_m, away_m) in enumerate(PLACES):
        rng = np.random.default_rng([7, k])
        before = rng.bit_generator.state
        report = plan_at(ready, k, rng)
        if report.plan is None or rng.bit_generator.state == before:
            continue
        searched += 1
        base = front_base(scene, dx_m=dx_m, away_m=away_m)
        SceneJudge(scene, arm(), base).check(report.plan, box_grasps().T_object_tcp[report.plan.grasp])
    assert searched >= 1


def test_another_order_and_another_process_give_the_same_bits() -> None:
    here = digests([0, 1, 2, 3, 4])
    program = "from tests.workers.motion.test_repeatability import digests; print(digests([4, 2, 0, 3, 1]))"
    told = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert ast.literal_eval(told.stdout) == here
