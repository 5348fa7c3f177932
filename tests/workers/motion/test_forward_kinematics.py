"""Links of many joint vectors at once, against the robot itself; the table of what an arm reaches."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.workers.motion.forward_kinematics import forward_kinematics
from datagen.workers.motion.planning_scene import moving_of
from datagen.workers.motion.reach_table import order_by_distance, reach_table
from datagen.workers.robots import ROBOTS, open_robot, robot_limits
from datagen.workers.robots.robot import Robot
from tests.workers.motion.tables import arm


def robots() -> list[Robot]:
    opened = []
    for name in ROBOTS:
        limits = robot_limits(name)
        height_m = (limits.base_height_m or (0.7, 0.7))[0]
        reach_m = limits.reach_m[1]
        opened.append(open_robot(name, reach_m, height_m))
    return opened


@pytest.fixture(scope="module", params=range(len(ROBOTS)), ids=list(ROBOTS))
def robot(request: pytest.FixtureRequest) -> Robot:
    return robots()[request.param]


def joints(robot: Robot, count: int) -> np.ndarray:
    low, high = np.maximum(robot.q_lower_rad, -np.pi), np.minimum(robot.q_upper_rad, np.pi)
    return np.random.default_rng(1).uniform(low, high, (count, len(low)))


def test_poses_are_the_robots_own(robot: Robot) -> None:
    kinematics, q = forward_kinematics(robot), joints(robot, 60)
    T = kinematics.poses(q)
    for k in range(len(q)):
        np.testing.assert_allclose(T[k, :-1], robot.T_base_link(q[k]), atol=1e-9)
        np.testing.assert_allclose(T[k, -1], robot.T_base_tcp(q[k]), atol=1e-9)
    np.testing.assert_allclose(kinematics.tcp(q), T[:, -1], atol=1e-12)
    np.testing.assert_array_equal(kinematics.poses(q[:1]), T[:1])


def test_the_hand_is_taken_off_the_arm(robot: Robot) -> None:
    """What is planned with the fingers at the grasp's opening must not also come with the fingers open."""
    moving = moving_of(robot)
    parts = sum(len(p) for p in robot.link_parts_m)
    hand = len(robot.gripper.parts_at(robot.gripper.max_opening_m))
    assert len(moving.arm) + len(moving.hand.hulls) == parts
    assert len(moving.hand.hulls) == hand


def test_reachable_poses_lie_near_the_table_and_its_seeds_lead_there(robot: Robot) -> None:
    kinematics = forward_kinematics(robot)
    table = reach_table(robot, kinematics)
    T = kinematics.tcp(joints(robot, 100))
    distance, seeds = table.nearest(T, 3)
    assert np.isfinite(distance).mean() > 0.9
    assert ((seeds >= robot.q_lower_rad) & (seeds <= robot.q_upper_rad)).all()
    solved = [any(robot.ik(T[k], s) is not None for s in seeds[k]) for k in range(len(T))]
    assert np.mean(solved) > 0.9


def test_the_table_refuses_what_is_far_out_of_reach() -> None:
    robot = arm()
    table = reach_table(robot, forward_kinematics(robot))
    far = np.tile(np.eye(4), (2, 1, 1))
    far[:, 0, 3] = (1.5, -2.0)
    distance, _ = table.nearest(far, 1)
    assert len(order_by_distance(distance)) == 0
    np.testing.assert_array_equal(order_by_distance(np.array([0.3, 0.1, np.inf, 0.2])), [1, 3, 0])
