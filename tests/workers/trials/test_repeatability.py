"""The same trial is the same bits: in any order, in any process, beside any other work."""

from __future__ import annotations

import hashlib
import multiprocessing

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")

from sapien import physx

from datagen.schemas.specification import SettleParams, TrialParams
from datagen.workers.geometry.transforms import translation, yaw_pose
from datagen.workers.robots import open_robot
from datagen.workers.settling.sapien_physics import settle_sapien
from datagen.workers.trials import Disturbance
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.trial_scene import prepare_trials
from tests.workers.trials.worlds import base_before, on_top_m, plan_from_above, scene_with
from tests.workers.worlds import ball_model, box_model, cylinder_model

PARAMS = TrialParams()
COUNT = 3

MODELS = [
    box_model("box", (0.05, 0.05, 0.12)),
    cylinder_model("can", 0.033, 0.1),
    ball_model("ball", 0.03),
    cylinder_model("tin", 0.03, 0.04, sides=16),
]
SPOTS = [(0.0, 0.0), (-0.04, 0.09), (0.08, -0.02), (0.0, -0.11)]


def digest(k: int) -> str:
    """Outcome, numbers and every recorded pose of trial `k` of a few that touch a lot."""
    robot = open_robot("panda-scaled", 0.8, 0.8)
    base = base_before(robot, 0.5)
    scene = scene_with(MODELS, SPOTS)
    prepared = prepare_trials(scene, robot, PARAMS, 0.1)
    # Off to the side, so that the hand pushes the neighbours about.
    plan = plan_from_above(robot, base, on_top_m(scene, 0.05) + [0.0, 0.004 * k, 0.0], 0.08)
    disturbance = Disturbance(yaw_pose(0.002 * k, 0.0, 0.0, 0.03 * k), translation(0, 0.003 * k, 0), 0.4, 1.1)
    result = run_trial(prepared, base, plan, disturbance, record=True)
    assert result.recording is not None
    numbers = np.array([result.lift_m, result.slip_m, result.disturbed_m, result.simulated_s])
    parts = (numbers, result.recording.q_rad, result.recording.opening_m, result.recording.T_world_object)
    return hashlib.sha256(result.outcome.encode() + b"".join(part.tobytes() for part in parts)).hexdigest()


def test_order_processes_and_other_work_change_no_bit() -> None:
    here = [digest(k) for k in range(COUNT)]
    assert len(set(here)) == COUNT
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        there = pool.map(digest, [2, 0, 1], chunksize=1)
    assert [there[1], there[2], there[0]] == here
    for k in (2, 0, 1):
        T = np.stack([translation(0, 0, 1), translation(1, 0, 1)])
        settle_sapien((), MODELS[1:3], T, SettleParams(max_steps=10))
        assert digest(k) == here[k]


def test_settings_that_others_left_in_the_process_change_no_bit() -> None:
    before = digest(1)
    scene, body, shape = physx.get_scene_config(), physx.get_body_config(), physx.get_shape_config()
    try:
        physx.set_scene_config(enable_tgs=False, enable_pcm=False, bounce_threshold=0.1)
        physx.set_body_config(4, 2, 0.5)
        physx.set_shape_config(0.03, 0.001)
        assert digest(1) == before
    finally:
        physx.set_scene_config(scene)
        physx.set_body_config(body)
        physx.set_shape_config(shape)
