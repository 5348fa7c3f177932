"""Grasps that were used, counted; and the circle within which an arm reaches."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.drawing.arm_picture import best_success, reach_radius_m
from datagen.drawing.grasp_views import hand_outline, used_grasps
from datagen.drawing.posed_robot import robot_bodies
from datagen.schemas.outcomes import OUTCOMES
from datagen.workers.geometry.transforms import inverse, translation, yaw_pose

pytest.importorskip("pinocchio", reason="needs the extra `sim`")
from datagen.workers.robots import open_robot

SUCCESS = tuple(OUTCOMES).index("success")


def test_nearly_equal_grasps_are_one() -> None:
    a, b, turned = yaw_pose(0, 0, 0, 0), yaw_pose(0.02, 0, 0, 0), yaw_pose(0, 0, 0, 0.2)
    close = yaw_pose(0.0005, 0, 0, 0.01)
    used = used_grasps(np.array([b, a, close, turned, a, turned], np.float32))
    assert used.count.tolist() == [3, 2, 1]
    np.testing.assert_allclose(used.T_target_tcp, [a, turned, b], atol=1e-6)


def test_no_grasp_at_all() -> None:
    used = used_grasps(np.zeros((0, 4, 4), np.float32))
    assert len(used.count) == 0 and used.T_target_tcp.shape == (0, 4, 4)


@pytest.mark.parametrize(("name", "reach_m", "height_m"), [("panda-scaled", 0.7, 0.8), ("xarm7", None, 0.6)])
def test_the_outline_is_as_wide_as_the_open_hand(name: str, reach_m: float | None, height_m: float) -> None:
    arm = open_robot(name, reach_m, height_m)
    outline = hand_outline(arm.gripper)
    assert np.ptp(outline[..., 1]) == pytest.approx(arm.gripper.max_opening_m)
    bodies = robot_bodies(arm, 0.25)
    assert sorted(bodies.finger_side[list(bodies.hand)]) == [-1, 1]
    assert bodies.link[-1] == -1  # the pedestal


def test_no_hand_comes_outside_the_circle() -> None:
    """From outside of it the centre of the target cannot be reached, wherever the arm turns."""
    arm = open_robot("panda-scaled", 0.7, 0.8)
    target_m = np.array([0.0, 0.0, 0.9])
    radius_m = reach_radius_m(arm, float(target_m[2]))
    for share, reaches in ((1.02, False), (0.8, True)):
        T_world_base = yaw_pose(-share * radius_m, 0.0, arm.base_height_m, 0.0)
        gap_m = np.linalg.norm(
            inverse(T_world_base)[:3, :3] @ (target_m - T_world_base[:3, 3]) - arm.shoulder_m
        )
        assert (gap_m <= arm.reach_m) == reaches
    assert reach_radius_m(arm, 3.0) == pytest.approx(float(arm.shoulder_m[0]))  # far above: nowhere


def test_the_best_success_lifts_most_often_with_fewest_grasps() -> None:
    samples = {
        "outcome": np.array([1, SUCCESS, SUCCESS, SUCCESS, SUCCESS]),
        "path_clearance_m": np.array([9.0, 0.3, 0.1, 0.2, 0.9]),
        "trials": np.array([5, 5, 5, 5, 5]),
        "successes": np.array([5, 4, 5, 5, 5]),
        "attempts": np.array([5, 5, 5, 5, 6]),
    }
    assert best_success(samples) == 3
    planned = {name: samples[name] for name in ("outcome", "path_clearance_m")}
    assert best_success(planned) == 4
    assert best_success(planned | {"outcome": np.ones(5)}) is None


def test_grasps_are_counted_where_they_are_not_where_they_come_in_the_list() -> None:
    rng = np.random.default_rng(1)
    grasps = np.array([translation(*rng.uniform(-0.1, 0.1, 3)) for _ in range(6)])
    rows = rng.permutation(np.repeat(np.arange(6), [1, 2, 3, 4, 5, 6]))
    assert used_grasps(grasps[rows].astype(np.float32)).count.tolist() == [6, 5, 4, 3, 2, 1]
