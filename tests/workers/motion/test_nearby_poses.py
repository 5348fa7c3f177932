"""The search near grasps that have no plan: poses that keep their contacts, and plans that hold up."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.workers.geometry.mesh import F64
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.motion import PlanReport
from datagen.workers.motion.nearby_poses import NearbyPoses
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.motion.planning_scene import PlanningScene
from tests.workers.motion.tables import (
    PARAMS,
    arm,
    box_grasps,
    deepest_in_plan_m,
    digest,
    front_base,
    prepared,
    table_scene,
)

FROM_ABOVE, FROM_THE_SIDE = 0, 4  # rows of box_grasps
# Distances from which one grasp alone has no plan.
TOO_FAR_M = {FROM_ABOVE: 0.75, FROM_THE_SIDE: 0.65}
ORIGINS = NearbyPoses.of_grasps(box_grasps().T_object_tcp, np.full(len(box_grasps()), 0.06))


def searched(row: int, rounds: int | None, score: Callable[[F64, float], float]) -> PlanningScene:
    every = box_grasps()
    one = GraspSet(
        every.T_object_tcp[[row]], every.opening_m[[row]], every.score[[row]], 0.5, pose_score=score
    )
    params = PARAMS.model_copy(update={"nearby_rounds": rounds})
    return prepared(table_scene(), grasps=one, params=params)


def plan_from(ready: PlanningScene, away_m: float) -> PlanReport:
    return plan_candidate(ready, front_base(table_scene(), away_m=away_m), np.random.default_rng(0))


def held(T_object_tcp: F64, opening_m: float) -> float:
    return 1.0


@given(st.integers(0, 2**32), st.integers(1, 4), st.integers(1, 5))
def test_poses_stay_near_their_grasps(seed: int, rounds: int, each: int) -> None:
    """They turn freely about the closing axis alone; along it they do not move."""
    np.testing.assert_allclose(ORIGINS.T_world_tcp(), ORIGINS.T_world_grasp, atol=1e-12)
    poses, rng = ORIGINS, np.random.default_rng(seed)
    for _ in range(rounds):
        poses = poses.rows(rng.integers(0, len(poses.opening_m), 6)).varied(each, rng)
    T, T_grasp = poses.T_world_tcp(), poses.T_world_grasp
    assert T.shape == (6 * each, 4, 4)
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12)
    closing = (R[:, :, 1] * T_grasp[:, :3, 1]).sum(1)
    assert np.degrees(np.arccos(np.clip(closing, -1, 1))).max() < 12
    moved = np.einsum("nij,ni->nj", T_grasp[:, :3, :3], T[:, :3, 3] - T_grasp[:, :3, 3])
    assert np.abs(moved).max() <= 0.006 + 1e-12 and np.abs(moved[:, 1]).max() < 1e-12


def test_turns_about_the_closing_axis_are_wide() -> None:
    approach = ORIGINS.varied(200, np.random.default_rng(1)).T_world_tcp()[:, :3, 2]
    cosine = (approach * np.repeat(ORIGINS.T_world_grasp[:, :3, 2], 200, axis=0)).sum(1)
    assert np.quantile(cosine, 0.5) < np.cos(np.radians(10)) and cosine.min() < np.cos(np.radians(40))


@pytest.mark.parametrize("row", [FROM_ABOVE, FROM_THE_SIDE])
def test_a_base_from_which_one_grasp_fails_finds_a_pose_near_it(row: int) -> None:
    away_m = TOO_FAR_M[row]
    assert plan_from(searched(row, None, held), away_m).plan is None
    report = plan_from(searched(row, 3, held), away_m)
    assert report.outcome == "success" and report.plan is not None and report.grasps_tried > 1
    base, scene, robot = front_base(table_scene(), away_m=away_m), table_scene(), arm()
    assert deepest_in_plan_m(scene, robot, report.plan, base) < 0
    T = base @ robot.T_base_tcp(report.plan.q_approach_rad[-1])
    T_grasp = scene.T_world_object[0] @ box_grasps().T_object_tcp[row]
    assert abs(T[:3, 1] @ T_grasp[:3, 1]) > np.cos(np.radians(12))
    assert np.linalg.norm(T[:3, 3] - T_grasp[:3, 3]) < 0.01
    assert (report.plan.grasp, report.plan.grasp_score) == (-1, 1.0)
    assert digest(report) == digest(plan_from(searched(row, 3, held), away_m))


def test_a_grasp_with_a_plan_is_taken_as_without_the_search() -> None:
    for away_m in (0.4, 0.55, 0.7):
        with_search, without = (plan_from(searched(FROM_ABOVE, n, held), away_m) for n in (3, None))
        assert without.plan is not None and digest(with_search) == digest(without)


def test_the_hand_must_hold_the_object_in_the_pose() -> None:
    seen: list[tuple[F64, float]] = []

    def dropped(T_object_tcp: F64, opening_m: float) -> float:
        seen.append((T_object_tcp, opening_m))
        return 0.0

    assert plan_from(searched(FROM_ABOVE, 3, dropped), TOO_FAR_M[FROM_ABOVE]).outcome == "no_path"
    grasp = box_grasps().T_object_tcp[FROM_ABOVE]
    assert seen and all(np.linalg.norm((T - grasp)[:3, 3]) < 0.01 for T, _ in seen)
    assert {opening_m for _, opening_m in seen} == {float(box_grasps().opening_m[FROM_ABOVE])}


def test_a_base_out_of_reach_stays_so() -> None:
    report = plan_from(searched(FROM_THE_SIDE, 3, held), 1.2)
    assert (report.outcome, report.plan) == ("no_ik", None)
