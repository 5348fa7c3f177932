"""The map of where a hand can be: samples lie in the cells of their poses, and lead to solutions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.motion import reach_map as reach_maps
from datagen.workers.motion.arm_model import arm_of
from datagen.workers.motion.reach_map import (
    ReachMap,
    cells_near,
    reach_map,
    reach_workspace,
    score,
    seeds,
)
from datagen.workers.robots.robot import Robot
from tests.workers.kinematics.trees import random_tree
from tests.workers.motion.tables import arm
from tests.workers.oracles import TreeOracle
from tests.workers.robots.robots_under_test import CASES, opened


@pytest.fixture(params=CASES)
def robot(request: pytest.FixtureRequest) -> Robot:
    return opened(request.param)


def seeds_at(reach: ReachMap, tree: object, T: F64, most: int, coordinates: int) -> F64:
    out = np.empty((most, coordinates))
    return out[
        : seeds(in_memory(reach), tree, np.ascontiguousarray(T[:3]), out, reach_workspace(coordinates))
    ]


def score_at(reach: ReachMap, T: F64) -> int:
    return score(in_memory(reach), np.ascontiguousarray(T[:3]), reach_workspace(reach.q.shape[1]))


def test_reachable_poses_have_samples_whose_seeds_lead_there(robot: Robot) -> None:
    reach, rng, solved = arm_of(robot).reach, np.random.default_rng(1), list[bool]()
    tree, apart, gaps_m = in_memory(arm_of(robot).tree), list[float](), list[float]()
    low, high = robot.q_lower_rad, robot.q_upper_rad
    low, high = np.maximum(low, np.minimum(-np.pi, high - 2 * np.pi)), np.minimum(high, low + 2 * np.pi)
    for _ in range(60):
        T = robot.T_base_tcp(rng.uniform(low, high))
        found = seeds_at(reach, tree, T, 4, len(robot.joint_names))
        assert (score_at(reach, T) > 0) == (len(found) > 0)
        assert ((found >= robot.q_lower_rad) & (found <= robot.q_upper_rad)).all()
        solved.append(any(robot.ik(T, q) is not None for q in found))
        gaps_m += [float(np.linalg.norm((robot.T_base_tcp(q) - T)[:3, 3])) for q in found]
        apart += [min(np.abs(q - p).max() for p in found[:k]) for k, q in enumerate(found) if k]
    assert np.mean(solved) > 0.9
    assert np.median(gaps_m) < 0.25 * reach.half_m
    # A lift, a telescope and a base that turns lead to most poses in one way alone.
    assert np.median(apart) > (0.35 if robot.name == "stretch3" else 0.5)
    far = robot.T_base_tcp(robot.homes_rad[0])
    for way in (np.array([1.0, 0, 0]), np.array([-0.6, 0.8, 0]), np.array([0, 0, 1.0])):
        far[:3, 3] = robot.shoulder_m + way * (robot.shoulder_m @ way * -2 + 1.7 * robot.reach_m + 2.0)
        assert score_at(reach, far) == 0


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_samples_lie_in_the_cells_of_their_poses(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """However the whole arm is turned about an upright first joint: the seed is turned as much."""
    monkeypatch.setattr(reach_maps, "_SAMPLES", 1 << 10)
    monkeypatch.setattr(reach_maps, "_FIRST_SAMPLES", 1 << 9)
    rng = np.random.default_rng(seed)
    tree = random_tree(rng)
    if tree.frame_joint[-1] < 0 or len(tree.lower) < 3:
        return
    tree = tree._replace(slides=tree.slides[tree.coordinate])  # no coordinate both slides and turns
    if rng.random() < 0.6:  # upright
        T = tree.T_parent_joint.copy()
        T[0, :3, :3], first = np.eye(3), tree.slides.copy()
        first[tree.coordinate == tree.coordinate[0]] = rng.random() < 0.2
        tree = tree._replace(T_parent_joint=T, axis=np.vstack([[0.0, 0.0, 1.0], tree.axis[1:]]), slides=first)
    most = np.full(len(tree.lower), np.pi)
    most[tree.coordinate[tree.slides]] = 0.2
    tree = tree.along_z()._replace(lower=-most, upper=most)
    reach, oracle, wrong = reach_map(tree), TreeOracle(tree), 0
    assert reach.first[0] == 0 and reach.first[-1] == len(reach.q) == 1 << 10
    cells, feature = np.empty(7, np.int64), np.empty(8)
    for row in rng.integers(0, len(reach.q), 40):
        q, turn_rad = reach.q[row].astype(np.float64), rng.uniform(-3, 3) if reach.turn >= 0 else 0.0
        about = yaw_pose(*reach.axis_xy_m, 0.0, 0.0)
        T = about @ yaw_pose(0.0, 0.0, 0.0, turn_rad) @ np.linalg.inv(about) @ oracle.frames(q)[-1]
        cells_near(in_memory(reach), np.ascontiguousarray(T[:3]), cells, feature)
        own = int(np.searchsorted(reach.first, row, side="right")) - 1
        wrong += cells[0] != own
        found = seeds_at(reach, in_memory(tree), T, 24, q.shape[0])
        if cells[0] == own:  # the first seed is the cell's first sample, turned as the pose is
            first = reach.q[reach.first[own]] + turn_rad * (np.arange(len(most)) == reach.turn)
            np.testing.assert_allclose(np.exp(1j * found[0]), np.exp(1j * first), atol=1e-3)
            assert score_at(reach, T) >= 8 * (reach.first[own + 1] - reach.first[own])
    assert wrong <= 4  # samples are kept with few digits, and may lie on a border


def test_arms_that_are_scaled_copies_share_samples() -> None:
    """Short arms too, which carry a tube between the flange and a hand that is not scaled."""
    maps = [reach_map(arm_of(r).tree) for r in (arm(0.45), arm(0.6), arm(0.95))]
    assert all(m.q is maps[0].q and m.first is maps[0].first for m in maps)
    assert maps[0].half_m < maps[1].half_m < maps[2].half_m
    assert not np.array_equal(arm_of(arm(0.6), draw=1).reach.q, maps[0].q)
    assert arm_of(arm(0.6)) is arm_of(arm(0.6, 0.9)) is not arm_of(arm(0.95))
