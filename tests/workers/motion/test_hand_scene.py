"""What robots of one hand share in a scene, and the grasps that are searched for a scene alone."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.workers.grasps.grasp import GraspSet
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.motion.planning_scene import PlanningScene, prepare
from datagen.workers.scenes.scene import SettledScene
from tests.workers.motion.tables import (
    BOX_M,
    PARAMS,
    PEDESTAL_M,
    arm,
    box_grasps,
    front_base,
    over_target,
    table_scene,
)


def some_grasps(rows: np.ndarray) -> GraspSet:
    every = box_grasps()
    return GraspSet(every.T_object_tcp[rows], every.opening_m[rows], every.score[rows])


FROM_ABOVE = np.flatnonzero(box_grasps().T_object_tcp[:, 2, 2] < -0.5)
FROM_SIDES = np.flatnonzero(box_grasps().T_object_tcp[:, 2, 2] > -0.5)


def below_a_shelf() -> SettledScene:
    return table_scene([over_target("shelf", (0.5, 0.3, 0.02), BOX_M[2] + 0.15)])


def prepared_for(
    scene: SettledScene, grasps: GraspSet, reach_m: float = 0.85, count: int = 40
) -> PlanningScene:
    return prepare(scene, arm(reach_m), grasps, PARAMS, count, PEDESTAL_M)


def test_robots_with_one_hand_share_the_scene() -> None:
    scene, grasps = table_scene(), box_grasps()
    long, short = (prepared_for(scene, grasps, reach_m) for reach_m in (0.85, 0.6))
    assert long.around is short.around
    assert prepared_for(scene, grasps, count=2).around is not long.around
    assert prepared_for(table_scene(), grasps).around is not long.around


def test_the_best_are_kept_in_both_turns() -> None:
    around = prepared_for(table_scene(), box_grasps(), count=3).around
    assert set(around.grasp.tolist()) == {0, 1, 2} and around.grasps_free == len(box_grasps())
    for row in range(3):
        first, turned = around.T_world_tcp[around.grasp == row]
        np.testing.assert_allclose(turned[:3, :2], -first[:3, :2], atol=1e-12)
        np.testing.assert_array_equal(turned[:3, 2:], first[:3, 2:])


def test_where_all_grasps_are_taken_others_are_searched_among_the_free() -> None:
    scene, asked = below_a_shelf(), []

    def further(is_free) -> GraspSet:
        every = box_grasps()
        free = is_free(every.T_object_tcp, every.opening_m.astype(np.float64))
        asked.append(free)
        return some_grasps(np.flatnonzero(free))

    ready = prepare(scene, arm(), some_grasps(FROM_ABOVE), PARAMS, 40, PEDESTAL_M, further=further)
    (free,) = asked
    assert not free[FROM_ABOVE].any() and free[FROM_SIDES].all()
    assert len(ready.around.grasps) == ready.grasps_free == len(FROM_SIDES)
    report = plan_candidate(ready, front_base(scene), np.random.default_rng(0))
    assert report.plan is not None and report.plan.grasp < len(FROM_SIDES)
    alone = prepare(below_a_shelf(), arm(), some_grasps(FROM_ABOVE), PARAMS, 40, PEDESTAL_M)
    assert alone.grasps_free == 0


def test_nothing_is_searched_where_a_grasp_is_free() -> None:
    for scene in (table_scene(), below_a_shelf()):
        ready = prepare(
            scene, arm(), box_grasps(), PARAMS, 40, PEDESTAL_M, further=lambda _: pytest.fail("searched")
        )
        assert ready.grasps_free > 0
