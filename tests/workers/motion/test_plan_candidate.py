"""Plans on hand-made tables: found where they must be, free by a second check, refused where none can be."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.workers.geometry.mesh import F64
from datagen.workers.houses.house import StaticBody
from datagen.workers.motion import MotionPlan, PlanReport
from datagen.workers.motion.plan_candidate import STAGES, plan_candidate
from datagen.workers.robots import ROBOTS
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from tests.workers.motion.plan_checks import SceneJudge
from tests.workers.motion.tables import (
    BOX_M,
    PARAMS,
    TARGET_XY_M,
    arm,
    box_grasps,
    front_base,
    over_target,
    prepared,
    table_scene,
)
from tests.workers.robots.robots_under_test import CASES, Case, opened
from tests.workers.worlds import ROOM_M, box_body, box_model

CLUTTER = [
    (box_model("carton", (0.08, 0.06, 0.2)), 0.12, -0.1),
    (box_model("low", (0.1, 0.1, 0.05)), -0.14, -0.2),
    (box_model("tower", (0.05, 0.05, 0.3)), 0.0, 0.0),
]


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def plan_at(scene: SettledScene, T_world_base: F64, **changes: object) -> PlanReport:
    return plan_candidate(prepared(scene, **changes), T_world_base, rng())  # type: ignore[arg-type]


def made(report: PlanReport) -> MotionPlan:
    assert report.outcome == "success"
    assert report.plan is not None
    return report.plan


@pytest.mark.parametrize("clutter", [[], CLUTTER], ids=["alone", "clutter"])
@pytest.mark.parametrize("dx_m", [-0.2, 0.0, 0.25])
def test_a_reachable_box_is_planned_and_the_plan_holds(clutter: list, dx_m: float) -> None:
    scene = table_scene(clutter=clutter)
    base = front_base(table_scene(), dx_m=dx_m)
    judged(scene, arm(), base, plan_at(scene, base))


@pytest.mark.parametrize("case", [next(c for c in CASES if c.id.startswith(n)) for n in ROBOTS])
def test_plans_of_every_robot_hold_in_generated_scenes(case: Case) -> None:
    """The judge uses nothing of the planner; each robot gets some plans among random boxes and boards."""
    robot, plans = opened(case), 0
    if robot.reach_m < 0.5:
        robot = arm()
    for seed in range(2):
        rng = np.random.default_rng(seed)
        sizes = rng.uniform((0.04, 0.04, 0.04), (0.12, 0.12, 0.3), (4, 3))
        places = rng.uniform((-0.4, -0.3), (0.4, 0.3), (4, 2))
        kept = np.abs(places - TARGET_XY_M).max(axis=1) > 0.1
        clutter = [
            (box_model(f"box {k}", tuple(sizes[k])), *places[k]) for k in np.flatnonzero(kept).tolist()
        ]
        shelf = over_target("shelf", (0.6, 0.2, 0.02), rng.uniform(0.3, 0.5), rng.uniform(-0.1, 0.2))
        scene = table_scene([shelf], clutter)
        ready = prepared(scene, robot)
        for away_m in (0.5, 0.7):
            base = front_base(scene, robot, rng.uniform(-0.3, 0.3), away_m)
            report = plan_candidate(ready, base, rng)
            if report.plan is not None:
                judged(scene, robot, base, report)
                plans += 1
    assert plans >= 1


def judged(scene: SettledScene, robot: Robot, base: F64, report: PlanReport) -> None:
    plan = made(report)
    SceneJudge(scene, robot, base).check(plan, box_grasps().T_object_tcp[plan.grasp])


def test_a_plan_needs_no_pregrasp() -> None:
    params = PARAMS.model_copy(update={"pregrasp_m": 0.0})
    report = plan_at(table_scene(), front_base(table_scene()), params=params)
    plan = made(report)
    assert len(plan.q_approach_rad) == 1
    np.testing.assert_array_equal(plan.q_reach_rad[-1], plan.q_lift_rad[0])


def test_a_low_shelf_leaves_no_grasp_from_above() -> None:
    shelf = over_target("shelf", (0.5, 0.3, 0.02), BOX_M[2] + 0.15)
    scene = table_scene([shelf])
    ready = prepared(scene)
    assert 0 < ready.around.grasps_free < len(box_grasps())
    free = ready.around.arrays.is_free > 0
    assert (ready.around.arrays.T_world_tcp[free, 2, 2] > -0.5).all()
    judged(scene, arm(), front_base(scene), plan_candidate(ready, front_base(scene), rng()))


@pytest.mark.parametrize(
    ("size_m", "low_m"),
    [
        ((0.5, 0.3, 0.02), BOX_M[2] + PARAMS.lift_m - 0.03),  # no room to lift
        ((0.6, 0.6, 0.8), -0.1),  # a solid block around the target: no surface is cut
    ],
)
def test_a_target_under_a_board_or_in_a_block_has_no_grasp(
    size_m: tuple[float, float, float], low_m: float
) -> None:
    report = plan_at(table_scene([over_target("board", size_m, low_m)]), front_base(table_scene()))
    assert (report.outcome, report.plan, report.grasps_free, report.grasps_tried) == ("no_grasp", None, 0, 0)


def wall_in_front(height_m: float) -> StaticBody:
    """A thin wall across the room, between the base in front of the table and the table."""
    return box_body(
        "wall|between", "wall", "Wall", (ROOM_M[0], 0.02, height_m), (ROOM_M[0] / 2, 1.07, height_m / 2)
    )


def test_a_wall_between_base_and_target_stops_the_arm() -> None:
    report = plan_at(table_scene([wall_in_front(2.5)]), front_base(table_scene()))
    assert report.outcome in ("arm_collision", "no_start", "no_approach", "no_path")
    low = plan_at(table_scene([wall_in_front(0.76)]), front_base(table_scene()))
    assert low.outcome == "success"


def test_no_tucked_pose_that_is_free_is_no_start() -> None:
    base, robot = front_base(table_scene()), arm()
    tcps = np.array([(base @ robot.T_base_tcp(q))[:3, 3] for q in robot.homes_rad])
    cubes = [
        box_body(f"cube|{k}", "furniture", "Box", (0.06, 0.06, 0.06), tuple(p)) for k, p in enumerate(tcps)
    ]
    assert plan_at(table_scene(cubes), base).outcome in ("no_start", "arm_collision")


def test_too_far_or_too_near_has_no_joint_configuration() -> None:
    scene = table_scene()
    assert plan_at(scene, front_base(scene, away_m=0.84)).outcome == "no_ik"
    assert plan_at(scene, front_base(scene, away_m=2.0)).outcome == "no_ik"


def test_a_block_in_a_fixed_link_is_a_collision() -> None:
    """A block behind the shoulder, into which no moving link reaches from here."""
    scene = table_scene()
    base = front_base(scene)
    at = (base @ np.array([-0.12, 0.0, 0.05, 1.0]))[:3]
    block = box_body("block", "furniture", "Box", (0.03, 0.03, 0.03), tuple(at))
    assert plan_at(scene, base).outcome == "success"
    assert plan_at(table_scene([block]), base).outcome == "arm_collision"
    assert SceneJudge(table_scene([block]), arm(), base).fixed_gap_m() < 0


@pytest.mark.parametrize(("height_m", "away_m"), [(0.9, 0.78), (1.1, 0.7), (1.3, 0.5)])
def test_the_cause_is_that_of_the_grasp_that_came_furthest(height_m: float, away_m: float) -> None:
    scene = table_scene([wall_in_front(height_m)])
    ready, base = prepared(scene), front_base(scene, away_m=away_m)
    report, rows = plan_candidate(ready, base, rng()), set(ready.around.grasp.tolist())
    alone = [plan_candidate(ready, base, rng(), frozenset(rows - {row})).outcome for row in rows]
    assert len(set(alone)) > 1 and report.outcome == max(alone, key=STAGES.index)


def test_skipped_grasps_are_not_used_again() -> None:
    scene = table_scene()
    ready, base = prepared(scene), front_base(scene)
    used: set[int] = set()
    while True:
        report = plan_candidate(ready, base, rng(), frozenset(used))
        if report.plan is None:
            break
        assert report.plan.grasp not in used
        used.add(report.plan.grasp)
    assert len(used) >= 3
    assert plan_candidate(ready, base, rng(), frozenset(range(len(box_grasps())))).outcome == "no_grasp"


def test_taking_clutter_away_turns_no_success_into_a_collision() -> None:
    full, empty = table_scene(clutter=CLUTTER), table_scene()
    a, b = prepared(full), prepared(empty)
    assert a.around.grasps_free <= b.around.grasps_free
    for dx in (-0.4, -0.2, 0.0, 0.2, 0.4):
        for away in (0.45, 0.6):
            base = front_base(full, dx_m=dx, away_m=away)
            with_clutter = plan_candidate(a, base, rng())
            without = plan_candidate(b, base, rng())
            assert with_clutter.outcome != "success" or without.outcome == "success"


def test_the_floor_under_a_low_target_is_no_collision_of_the_mount() -> None:
    scene = table_scene()
    robot = arm(0.85, 0.5)
    assert plan_at(scene, front_base(scene, robot), robot=robot).outcome == "success"


def test_a_target_deep_within_another_thing_is_taken_by_no_grasp() -> None:
    scene = table_scene()
    for overlap_m, is_held in ((0.003, False), (0.02, True)):
        beside = BOX_M[0] / 2 + 0.06 / 2 - overlap_m
        low = (box_model("low", (0.06, 0.06, 0.05)), TARGET_XY_M[0], TARGET_XY_M[1] + beside)
        report = plan_at(table_scene(clutter=[low]), front_base(scene))
        assert (report.outcome == "no_grasp") == is_held, overlap_m
        assert (report.grasps_free == 0) == is_held
