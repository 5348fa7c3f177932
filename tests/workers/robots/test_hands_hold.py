"""Hands of real robots, with fingers that slide or turn, hold things of several sizes."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.workers.grasps.search import hand_poses_of, score_block
from datagen.workers.robots import gripper_of
from tests.sim_extra import named_robots, needs_sim
from tests.workers.worlds import box_model

# Robots with the hand of another one are left out.
HANDS = [robot for robot in named_robots() if robot.values[0] not in ("panda-scaled", "xarm7", "ur5")]


@needs_sim
@pytest.mark.parametrize("robot", HANDS)
@pytest.mark.parametrize("size_m", [0.02, 0.05])
def test_most_free_poses_around_a_box_hold_it(robot: str, size_m: float) -> None:
    gripper, box = gripper_of(robot), box_model("box", (size_m, size_m, 0.1))
    rng = np.random.default_rng(0)
    poses = hand_poses_of(box, gripper, rng)
    score = score_block(box, gripper, poses, 0, rng)
    assert len(score) == 32 and (score >= 0.6).mean() > 0.5
