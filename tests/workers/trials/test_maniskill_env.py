"""The ManiSkill environment and the workers' own trials come to the same end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")

from datagen.schemas.errors import InputError
from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.motion import MotionPlan
from datagen.workers.robots import open_robot
from datagen.workers.trials import Disturbance
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.trial_scene import TrialScene, prepare_trials
from tests.workers.trials.worlds import base_before, on_top_m, plan_from_above, scene_with
from tests.workers.worlds import box_model, cylinder_model

PARAMS = TrialParams()
MODELS = [box_model("target", (0.05, 0.05, 0.12), 0.6), cylinder_model("other", 0.03, 0.1)]
WORLDS = {
    "as planned": (Disturbance.none(0.6), "success"),
    "slippery": (Disturbance.none(0.001), "slipped"),
    "moved away": (Disturbance(translation(0.0, 0.12, 0.0), np.eye(4), 0.6, 1.0), "missed"),
}


@dataclass(frozen=True)
class Planned:
    """A plan of a robot in a scene."""

    prepared: TrialScene
    base: F64
    plan: MotionPlan


@pytest.fixture(scope="module")
def planned() -> Planned:
    robot = open_robot("panda-scaled", 0.8, 0.8)
    base = base_before(robot, 0.5)
    prepared = prepare_trials(scene_with(MODELS, [(0.0, 0.0), (0.0, 0.2)]), robot, PARAMS, 0.1)
    grasped_m = on_top_m(scene_with(MODELS[:1], [(0.0, 0.0)]), 0.03)
    return Planned(prepared, base, plan_from_above(robot, base, grasped_m, 0.07))


@pytest.fixture(scope="module")
def engine() -> Iterator[Any]:
    """Our module of the environment. Imported here, for every test process imports this file, and ManiSkill
    takes a quarter as long as all other libraries.

    ManiSkill changes SAPIEN's settings for the whole process: other tests shall not see them.
    """
    pytest.importorskip("mani_skill", reason="ManiSkill cannot be imported here")
    from sapien import physx

    from examples.maniskill import environment

    scene, body, shape = physx.get_scene_config(), physx.get_body_config(), physx.get_shape_config()
    yield environment
    physx.set_scene_config(scene)
    physx.set_body_config(body)
    physx.set_shape_config(shape)


def made(engine: Any, *tasks: Any) -> closing[Any]:
    """The registered environment with these tasks."""
    import gymnasium

    return closing(gymnasium.make(engine.ENV_ID, tasks=list(tasks), obs_mode="state"))


@pytest.mark.parametrize("world", WORLDS)
def test_both_engines_agree(engine: Any, planned: Planned, world: str) -> None:
    disturbance, outcome = WORLDS[world]
    task = engine.GraspTask(planned.prepared, planned.base, planned.plan, disturbance)
    own = run_trial(planned.prepared, planned.base, planned.plan, disturbance)
    assert own.outcome == outcome
    with made(engine, task) as env:
        unwrapped = env.unwrapped
        assert isinstance(unwrapped, engine.DatagenGraspEnv)
        assert engine.execute_plans(unwrapped).tolist() == [outcome == "success"]
        if outcome == "success":
            lift_m = float(unwrapped.evaluate()["lift_m"][0])
            assert lift_m == pytest.approx(own.lift_m, abs=0.003)
            assert unwrapped.get_obs().shape == env.observation_space.shape


def test_a_policy_can_step_it(engine: Any, planned: Planned) -> None:
    task = engine.GraspTask(planned.prepared, planned.base, planned.plan, Disturbance.none(0.6))
    with made(engine, task) as env:
        env.reset(seed=0)
        observed, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert bool(observed.isfinite().all())
        assert float(reward) == 0.0 and not bool(terminated) and not bool(truncated)
        assert set(info) >= {"success", "held", "lift_m", "slip_m"}


def test_tasks_of_different_robots_are_refused(engine: Any, planned: Planned) -> None:
    other = open_robot("panda-scaled", 0.7, 0.8)
    prepared = prepare_trials(scene_with(MODELS[:1], [(0.0, 0.0)]), other, PARAMS, 0.1)
    tasks = [
        engine.GraspTask(p, planned.base, planned.plan, Disturbance.none(0.6))
        for p in (planned.prepared, prepared)
    ]
    for refused, problem in ((tasks, "differ in robot"), ([], "are missing")):
        with pytest.raises(InputError, match=problem):
            made(engine, *refused)
