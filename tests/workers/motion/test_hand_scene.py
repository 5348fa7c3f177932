"""What robots of one hand share in a scene, and the grasps that are searched for a scene alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.workers.geometry.transforms import inverse
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.grasps.search import HandClearance
from datagen.workers.motion import PlanReport
from datagen.workers.motion.grasp_filter import hand_of
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.motion.planning_scene import PlanningScene, hand_scene
from datagen.workers.scenes import SettledScene
from tests.workers.motion.tables import (
    BOX_M,
    PARAMS,
    arm,
    box_grasps,
    front_base,
    over_target,
    prepared,
    table_scene,
)
from tests.workers.worlds import box_vertices

FROM_ABOVE = np.flatnonzero(box_grasps().T_object_tcp[:, 2, 2] < -0.5)
FROM_SIDES = np.flatnonzero(box_grasps().T_object_tcp[:, 2, 2] > -0.5)


def below_a_shelf() -> SettledScene:
    return table_scene([over_target("shelf", (0.5, 0.3, 0.02), BOX_M[2] + 0.15)])


def test_robots_with_one_hand_share_the_scene() -> None:
    scene, grasps = table_scene(), box_grasps()
    long, short = (prepared(scene, arm(reach_m), grasps) for reach_m in (0.85, 0.6))
    assert long.around is short.around
    assert prepared(scene, arm(), grasps, per_scene=2).around is not long.around
    assert prepared(table_scene(), arm(), grasps).around is not long.around


def test_every_grasp_comes_in_both_turns() -> None:
    around = prepared(table_scene(), per_scene=3).around
    assert around.grasp[around.kept].tolist() == [0, 0, 1, 1, 2, 2] and around.grasps_free == 3
    assert set(around.grasp[around.rest].tolist()) == set(range(3, len(box_grasps())))
    np.testing.assert_allclose(around.T_world_tcp[1::2, :3, :2], -around.T_world_tcp[::2, :3, :2], atol=1e-12)
    np.testing.assert_array_equal(around.T_world_tcp[1::2, :3, 2:], around.T_world_tcp[::2, :3, 2:])


def test_all_grasps_are_checked_where_the_first_are_blocked() -> None:
    """Those from above come first here, and a shelf takes them."""
    assert (np.diff(box_grasps().T_object_tcp[:, 2, 2]) >= 0).all()
    some = prepared(below_a_shelf(), per_scene=len(FROM_ABOVE))
    assert some.grasps_free == len(FROM_SIDES) and len(some.around.rest) == 0
    assert plan_at(some, below_a_shelf()).outcome == "success"
    every, rows = box_grasps(), FROM_ABOVE
    from_above = GraspSet(every.T_object_tcp[rows], every.opening_m[rows], every.score[rows])
    none = prepared(below_a_shelf(), grasps=from_above)
    assert none.grasps_free == 0 and plan_at(none, below_a_shelf()).outcome == "no_grasp"


def test_a_candidate_tries_other_grasps_where_the_first_fail() -> None:
    """With how many a scene is looked at first decides nothing but the cost."""
    scene = table_scene()
    bases = [front_base(scene, dx_m=dx, away_m=d) for dx in (-0.3, 0.0, 0.3) for d in (0.45, 0.65, 0.75)]
    few, all_of_them = (prepared(scene, per_scene=n) for n in (1, 40))
    assert len(few.around.rest) > 0
    for base in bases:
        labels = [plan_candidate(p, base, np.random.default_rng(0)).plan is None for p in (few, all_of_them)]
        assert labels[0] == labels[1]


def test_a_grasp_that_does_not_hold_gives_no_plan() -> None:
    """Scores of later grasps are asked for when there is a plan."""
    scene, every, asked = table_scene(), box_grasps(), list[int]()
    first = plan_at(prepared(scene), scene).plan
    assert first is not None

    def later_score(row: int) -> float:
        asked.append(row)
        return float(row != first.grasp)

    unscored = GraspSet(every.T_object_tcp, every.opening_m, every.score[:0], 0.5, later_score)
    plan = plan_at(prepared(scene, grasps=unscored), scene).plan
    assert plan is not None and plan.grasp != first.grasp
    assert asked[0] == first.grasp and asked[-1] == plan.grasp
    nothing = GraspSet(every.T_object_tcp, every.opening_m, every.score[:0], 0.5, lambda _: 0.0)
    assert plan_at(prepared(scene, grasps=nothing), scene).plan is None


def plan_at(ready: PlanningScene, scene: SettledScene) -> PlanReport:
    return plan_candidate(ready, front_base(scene), np.random.default_rng(0))


def test_a_turned_grasp_that_cuts_the_target_is_omitted() -> None:
    """A lug on one side of the palm: over the box's end it passes beside the box, turned it cuts the box."""
    scene, robot = table_scene(), arm()
    lug = box_vertices((0.02, 0.02, 0.08), (0.03, 0.0, -0.01))
    gripper = replace(robot.gripper, digest="lug", palm_parts_m=(*robot.gripper.palm_parts_m, lug))
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (2, 1, 1))
    T[:, 0, 3], T[:, 2, 3] = (-0.02, 0.02), BOX_M[2] / 2 - 0.01
    grasps = GraspSet(T, np.full(2, 0.064, np.float32), np.ones(2, np.float32))
    around = hand_scene(scene, hand_of(gripper), grasps, PARAMS, 40, 2.0)
    fits = HandClearance(scene.models[0].convex_parts_m, gripper).free(
        np.matmul(inverse(scene.T_world_object[0]), around.T_world_tcp), around.opening_m
    )
    assert fits.tolist() == [False, True, True, False]
    np.testing.assert_array_equal(around.kept, np.flatnonzero(fits))
