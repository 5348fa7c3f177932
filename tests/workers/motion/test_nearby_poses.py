"""The search near grasps that have no plan: poses that keep their contacts, and plans that hold up."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.workers.geometry.mesh import F64
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.motion import PlanReport
from datagen.workers.motion.plan_candidate import STAGES, _varied, plan_candidate  # pyright: ignore
from datagen.workers.motion.planning_scene import PlanningScene
from tests.workers.motion.plan_checks import SceneJudge
from tests.workers.motion.tables import (
    PARAMS,
    arm,
    box_grasps,
    digest,
    front_base,
    prepared,
    table_scene,
)

FROM_ABOVE, FROM_THE_SIDE = 0, 6  # rows of box_grasps
# From here one grasp alone has no plan: the target cannot be lifted so high.
HIGH, TOO_FAR_M = PARAMS.model_copy(update={"lift_m": 0.15}), 0.7
GRASPS = np.ascontiguousarray(box_grasps().T_object_tcp[:, :3])


def searched(row: int, rounds: int | None, score: Callable[[F64, float], float]) -> PlanningScene:
    every = box_grasps()
    one = GraspSet(
        every.T_object_tcp[[row]], every.opening_m[[row]], every.score[[row]], 0.5, pose_score=score
    )
    params = HIGH.model_copy(update={"nearby_rounds": rounds})
    return prepared(table_scene(), grasps=one, params=params)


def plan_from(ready: PlanningScene, away_m: float) -> PlanReport:
    return plan_candidate(ready, front_base(table_scene(), away_m=away_m), np.random.default_rng(0))


def held(T_object_tcp: F64, opening_m: float) -> float:
    return 1.0


@given(st.integers(0, 2**32), st.integers(1, 4))
def test_poses_stay_near_their_grasps(seed: int, rounds: int) -> None:
    """They turn freely about the closing axis alone; along it they do not move."""
    rng = np.random.default_rng(seed)
    origin, motion = rng.integers(0, len(GRASPS), 40), np.zeros((40, 5))
    for _ in range(rounds):
        T, motion = _varied(GRASPS[origin], motion, rng)
    T_grasp, R = GRASPS[origin], T[:, :, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12)
    closing = (R[:, :, 1] * T_grasp[:, :, 1]).sum(1)
    assert np.degrees(np.arccos(np.clip(closing, -1, 1))).max() < 12
    moved = np.einsum("nij,ni->nj", T_grasp[:, :, :3], T[:, :, 3] - T_grasp[:, :, 3])
    assert np.abs(moved).max() <= 0.006 + 1e-12 and np.abs(moved[:, 1]).max() < 1e-12
    np.testing.assert_allclose(_varied(T_grasp, motion * 0, rng)[1][:, 3:], 0, atol=0.006)


def test_turns_about_the_closing_axis_are_wide() -> None:
    rows = np.repeat(GRASPS, 200, axis=0)
    T, _ = _varied(rows, np.zeros((len(rows), 5)), np.random.default_rng(1))
    cosine = (T[:, :, 2] * rows[:, :, 2]).sum(1)
    assert np.quantile(cosine, 0.5) < np.cos(np.radians(10)) and cosine.min() < np.cos(np.radians(40))


@pytest.mark.parametrize("row", [FROM_ABOVE, FROM_THE_SIDE])
def test_a_base_from_which_one_grasp_fails_finds_a_pose_near_it(row: int) -> None:
    assert plan_from(searched(row, None, held), TOO_FAR_M).outcome == "no_lift"
    report = plan_from(searched(row, 3, held), TOO_FAR_M)
    assert report.outcome == "success" and report.plan is not None and report.grasps_tried > 1
    base, scene, robot = front_base(table_scene(), away_m=TOO_FAR_M), table_scene(), arm()
    SceneJudge(scene, robot, base, HIGH).check(report.plan, None)
    T = base @ robot.T_base_tcp(report.plan.q_approach_rad[-1])
    T_grasp = scene.T_world_object[0] @ box_grasps().T_object_tcp[row]
    assert abs(T[:3, 1] @ T_grasp[:3, 1]) > np.cos(np.radians(12))
    assert np.linalg.norm(T[:3, 3] - T_grasp[:3, 3]) < 0.01
    assert (report.plan.grasp, report.plan.grasp_score) == (-1, 1.0)
    assert digest(report) == digest(plan_from(searched(row, 3, held), TOO_FAR_M))


def test_the_search_only_turns_no_into_yes() -> None:
    """Every plan that is found without it stays as it is, and the others pass the judge."""
    scene, more = table_scene(), 0
    for row in (FROM_ABOVE, FROM_THE_SIDE):
        without, with_search = (searched(row, n, held) for n in (None, 2))
        for away_m, dx_m in product((0.4, 0.6, 0.66, 0.7, 0.76, 0.8), (0.0, 0.2)):
            base = front_base(scene, dx_m=dx_m, away_m=away_m)
            before, after = (
                plan_candidate(p, base, np.random.default_rng(0)) for p in (without, with_search)
            )
            if before.plan is not None:
                assert digest(after) == digest(before)
            elif after.plan is not None:
                more += 1
                SceneJudge(scene, arm(), base, HIGH).check(after.plan, None)
            else:
                assert STAGES.index(after.outcome) >= STAGES.index(before.outcome)
    assert more >= 3


def test_the_hand_must_hold_the_object_in_the_pose() -> None:
    seen: list[tuple[F64, float]] = []

    def dropped(T_object_tcp: F64, opening_m: float) -> float:
        seen.append((T_object_tcp, opening_m))
        return 0.0

    assert plan_from(searched(FROM_ABOVE, 3, dropped), TOO_FAR_M).outcome == "no_path"
    grasp = box_grasps().T_object_tcp[FROM_ABOVE]
    assert seen and all(np.linalg.norm((T - grasp)[:3, 3]) < 0.01 for T, _ in seen)
    assert {opening_m for _, opening_m in seen} == {float(box_grasps().opening_m[FROM_ABOVE])}


def test_a_base_out_of_reach_stays_so() -> None:
    report = plan_from(searched(FROM_THE_SIDE, 3, held), 1.2)
    assert (report.outcome, report.plan) == ("no_ik", None)
