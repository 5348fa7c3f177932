"""The ManiSkill environment and the workers' own trials come to the same end."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="ManiSkill cannot be imported here")

import gymnasium as gym
import torch
from sapien import physx

from datagen.schemas.errors import InputError
from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.transforms import translation
from datagen.workers.robots import open_robot
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.maniskill_env import ENV_ID, DatagenGraspEnv, GraspTask, execute_plans
from datagen.workers.trials.trial import Disturbance
from datagen.workers.trials.trial_scene import prepare_trials
from tests.workers.trials.worlds import base_before, on_top_m, plan_from_above, scene_with
from tests.workers.worlds import box_model, cylinder_model

PARAMS = TrialParams()
ROBOT = open_robot("panda-scaled", 0.8, 0.8)
BASE = base_before(ROBOT, 0.5)
MODELS = [box_model("target", (0.05, 0.05, 0.12), 0.6), cylinder_model("other", 0.03, 0.1)]
PREPARED = prepare_trials(scene_with(MODELS, [(0.0, 0.0), (0.0, 0.2)]), ROBOT, PARAMS, 0.1)
PLAN = plan_from_above(ROBOT, BASE, on_top_m(scene_with(MODELS[:1], [(0.0, 0.0)]), 0.03), 0.07)
WORLDS = {
    "as planned": (Disturbance.none(0.6), "success"),
    "slippery": (Disturbance.none(0.001), "slipped"),
    "moved away": (Disturbance(translation(0.0, 0.12, 0.0), np.eye(4), 0.6, 1.0), "missed"),
}


@pytest.fixture(autouse=True, scope="module")
def settings_of_the_process() -> Iterator[None]:
    """ManiSkill changes SAPIEN's settings for the whole process: other tests shall not see them."""
    scene, body, shape = physx.get_scene_config(), physx.get_body_config(), physx.get_shape_config()
    yield
    physx.set_scene_config(scene)
    physx.set_body_config(body)
    physx.set_shape_config(shape)


@pytest.mark.parametrize("world", WORLDS)
def test_both_engines_agree(world: str) -> None:
    disturbance, outcome = WORLDS[world]
    task = GraspTask(PREPARED, BASE, PLAN, disturbance)
    own = run_trial(PREPARED, BASE, PLAN, disturbance)
    assert own.outcome == outcome
    env = gym.make(ENV_ID, tasks=[task], obs_mode="state")
    try:
        unwrapped = env.unwrapped
        assert isinstance(unwrapped, DatagenGraspEnv)
        assert execute_plans(unwrapped).tolist() == [outcome == "success"]
        if outcome == "success":
            lift_m = float(unwrapped.evaluate()["lift_m"][0])
            assert lift_m == pytest.approx(own.lift_m, abs=0.003)
            assert unwrapped.get_obs().shape == env.observation_space.shape
    finally:
        env.close()


def test_a_policy_can_step_it() -> None:
    env = gym.make(ENV_ID, tasks=[GraspTask(PREPARED, BASE, PLAN, Disturbance.none(0.6))], obs_mode="state")
    try:
        env.reset(seed=0)
        observed, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert torch.isfinite(observed).all()
        assert float(reward) == 0.0 and not bool(terminated) and not bool(truncated)
        assert set(info) >= {"success", "held", "lift_m", "slip_m"}
    finally:
        env.close()


def test_tasks_of_different_robots_are_refused() -> None:
    other = open_robot("panda-scaled", 0.7, 0.8)
    prepared = prepare_trials(scene_with(MODELS[:1], [(0.0, 0.0)]), other, PARAMS, 0.1)
    tasks = [GraspTask(p, BASE, PLAN, Disturbance.none(0.6)) for p in (PREPARED, prepared)]
    with pytest.raises(InputError, match="differ in robot"):
        gym.make(ENV_ID, tasks=tasks)
    with pytest.raises(InputError, match="are missing"):
        gym.make(ENV_ID, tasks=[])
