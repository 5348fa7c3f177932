"""Links of many joint vectors at once, against the robot itself; the table of what an arm reaches."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.workers.motion.forward_kinematics import forward_kinematics
from datagen.workers.motion.planning_scene import moving_of
from datagen.workers.motion.reach_table import reach_table
from datagen.workers.robots.robot import Robot
from tests.workers.motion.tables import arm
from tests.workers.robots.robots_under_test import CASES, opened


@pytest.fixture(params=CASES)
def robot(request: pytest.FixtureRequest) -> Robot:
    return opened(request.param)


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
    assert len(moving.fixed) + len(moving.arm) + len(moving.hand.hulls) == parts
    assert len(moving.hand.hulls) == len(robot.gripper.parts_at(robot.gripper.max_opening_m))


def test_reachable_poses_lie_near_the_table_and_its_seeds_lead_there(robot: Robot) -> None:
    kinematics = forward_kinematics(robot)
    table = reach_table(robot, kinematics)
    T = kinematics.tcp(joints(robot, 100))
    distance, seeds = table.distance(T), table.seeds(T, 3)
    assert np.isfinite(distance).mean() > 0.9
    assert ((seeds >= robot.q_lower_rad) & (seeds <= robot.q_upper_rad)).all()
    solved = [any(robot.ik(T[k], s) is not None for s in seeds[k]) for k in range(len(T))]
    assert np.mean(solved) > 0.9


def test_seeds_are_near_their_pose_and_differ(robot: Robot) -> None:
    kinematics = forward_kinematics(robot)
    table = reach_table(robot, kinematics)
    T = kinematics.tcp(joints(robot, 40))
    seeds = table.seeds(T, 4)
    alone = np.concatenate([table.seeds(T[k : k + 1], 4) for k in range(len(T))])
    np.testing.assert_array_equal(seeds, alone)
    np.testing.assert_array_equal(table.distance(T), [table.distance(T[k : k + 1])[0] for k in range(len(T))])
    np.testing.assert_array_equal(table.seeds(T, 1)[:, 0], seeds[:, 0])
    apart = np.abs(seeds[:, :, None] - seeds[:, None]).max(axis=3)[:, *np.triu_indices(4, 1)]
    # A lift, a telescope and a base that turns lead to most poses in one way alone.
    assert np.median(apart.min(axis=1)) > (0.35 if robot.name == "stretch3" else 0.5)
    reached = kinematics.tcp(seeds.reshape(-1, seeds.shape[2]))
    gap_m = np.linalg.norm(reached[:, :3, 3] - np.repeat(T[:, :3, 3], 4, axis=0), axis=1)
    assert np.median(gap_m) < 0.25 * table.length_m


def test_arms_that_are_scaled_copies_share_one_table_that_refuses_what_is_far_out_of_reach() -> None:
    """Short arms too, which carry a tube between the flange and a hand that is not scaled."""
    tables = [reach_table(r, forward_kinematics(r)) for r in (arm(0.45), arm(0.6), arm(0.95))]
    assert len({id(table.samples) for table in tables}) == 1
    assert tables[0].length_m < tables[1].length_m < tables[2].length_m
    far = np.tile(np.eye(4), (2, 1, 1))
    far[:, 0, 3] = (1.5, -2.0)
    assert not np.isfinite(tables[2].distance(far)).any()
    other = reach_table(arm(0.6), forward_kinematics(arm(0.6)), draw=1)
    assert not np.array_equal(other.samples.q_rad, tables[1].samples.q_rad)
