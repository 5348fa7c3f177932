"""Plans on hand-made tables: found where they must be, free by a second check, refused where none can be."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from datagen.workers.geometry.mesh import F64
from datagen.workers.houses.house import StaticBody
from datagen.workers.motion import MotionPlan, PlanReport
from datagen.workers.motion.arm_collision import surroundings
from datagen.workers.motion.plan_candidate import STAGES, plan_candidate
from datagen.workers.motion.planning_scene import prepare
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from tests.workers.motion.tables import (
    BOX_M,
    PARAMS,
    TARGET_XY_M,
    arm,
    box_grasps,
    deepest_in_plan_m,
    digest,
    front_base,
    over_target,
    prepared,
    table_scene,
)
from tests.workers.worlds import ROOM_M, box_body, box_model

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
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
def test_a_reachable_box_is_planned_and_the_plan_is_free(clutter: list, dx_m: float) -> None:
    scene = table_scene(clutter=clutter)
    robot, base = arm(), front_base(table_scene(), dx_m=dx_m)
    plan = made(plan_at(scene, base))
    assert deepest_in_plan_m(scene, robot, plan, base) < 0
    assert plan.clearance_m >= 0
    for rows in (plan.q_reach_rad, plan.q_approach_rad, plan.q_lift_rad):
        assert (rows >= robot.q_lower_rad - 1e-9).all()
        assert (rows <= robot.q_upper_rad + 1e-9).all()
        assert not any(robot.collides_itself(q) for q in rows)
    steps = np.linalg.norm(np.diff(plan.q_reach_rad, axis=0), axis=1)
    assert steps.max() <= PARAMS.check_step_rad + 1e-9
    for rows in (plan.q_approach_rad, plan.q_lift_rad):
        assert np.abs(np.diff(rows, axis=0)).max() <= PARAMS.max_joint_jump_rad


def test_phases_join_and_follow_the_grasp() -> None:
    scene, robot = table_scene(clutter=CLUTTER), arm()
    base = front_base(scene)
    plan = made(plan_at(scene, base))
    np.testing.assert_array_equal(plan.q_reach_rad[0], robot.homes_rad[plan.home])
    np.testing.assert_array_equal(plan.q_reach_rad[-1], plan.q_approach_rad[0])
    np.testing.assert_array_equal(plan.q_approach_rad[-1], plan.q_lift_rad[0])
    path = np.concatenate([plan.q_reach_rad, plan.q_approach_rad[1:]])
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert plan.length_rad == pytest.approx(length, abs=1e-9)

    def tcp(q: F64) -> F64:
        return base @ robot.T_base_tcp(q)

    wanted = scene.T_world_object[0] @ box_grasps().T_object_tcp[plan.grasp]
    reached = tcp(plan.q_approach_rad[-1])
    assert np.linalg.norm(reached[:3, 3] - wanted[:3, 3]) < 0.001
    turns = [np.trace(reached[:3, :3].T @ (wanted @ T)[:3, :3]) for T in (np.eye(4), HALF_TURN)]
    assert max(turns) > 1 + 2 * np.cos(np.radians(1))

    for rows, direction, length_m in (
        (plan.q_approach_rad[::-1], -wanted[:3, 2], PARAMS.pregrasp_m),
        (plan.q_lift_rad, np.array([0, 0, 1]), PARAMS.lift_m),
    ):
        dense = [a + f * (b - a) for a, b in pairwise(rows) for f in (0, 0.25, 0.5, 0.75)]
        way = np.array([tcp(q)[:3, 3] for q in [*dense, rows[-1]]]) - wanted[:3, 3]
        off = way - np.outer(way @ direction, direction)
        assert np.linalg.norm(off, axis=1).max() < 0.002
        assert way[-1] @ direction == pytest.approx(length_m, abs=0.001)


def test_a_low_shelf_leaves_no_grasp_from_above() -> None:
    shelf = over_target("shelf", (0.5, 0.3, 0.02), BOX_M[2] + 0.15)
    scene = table_scene([shelf])
    ready = prepared(scene)
    assert 0 < ready.grasps_free < len(box_grasps())
    assert (ready.around.T_world_tcp[ready.around.kept, 2, 2] > -0.5).all()
    plan = made(plan_candidate(ready, front_base(scene), rng()))
    assert deepest_in_plan_m(scene, arm(), plan, front_base(scene)) < 0


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


def test_no_report_depends_on_the_filter_by_the_wrist_or_on_how_many_grasps_are_looked_at_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = table_scene(clutter=CLUTTER)
    ready = prepared(scene, params=PARAMS.model_copy(update={"lift_m": 0.2}))
    bases = [front_base(scene, dx_m=dx, away_m=d) for dx in (0.0, 0.3) for d in np.arange(0.4, 0.95, 0.05)]
    fast = [plan_candidate(ready, base, rng()) for base in bases]
    every = lambda robot, T, beyond_m=0.0: np.ones(len(T), np.bool_)  # noqa: E731
    monkeypatch.setattr(Robot, "is_wrist_within_reach", every)
    monkeypatch.setattr("datagen.workers.motion.grasp_goals._FILTERED_AT_ONCE", 7)
    assert [digest(plan_candidate(ready, base, rng())) for base in bases] == list(map(digest, fast))
    assert {report.outcome for report in fast} >= {"success", "no_lift", "no_ik"}


def test_the_pedestal_is_an_obstacle_for_all_but_the_first_links() -> None:
    scene, robot = table_scene(), arm()
    base = front_base(scene, away_m=0.9)
    thin, thick = (prepare(scene, robot, box_grasps(), PARAMS, 40, r) for r in (0.1, 0.4))
    T = np.diag([1.0, -1.0, -1.0, 1.0])  # down, beside the pedestal and below the mount
    T[:3, 3] = (0.4, 0.0, -0.1)
    q = next(q for q in (robot.ik(T, home) for home in robot.homes_rad) if q is not None)
    assert surroundings(thin, base).first_blocked(q[None], 0.08) == 1
    assert surroundings(thick, base).first_blocked(q[None], 0.08) == 0
    assert surroundings(thick, base).free_homes.size


def test_a_block_in_a_fixed_link_is_a_collision() -> None:
    """A block behind the shoulder, into which no moving link reaches from here."""
    scene = table_scene()
    base = front_base(scene)
    at = (base @ np.array([-0.12, 0.0, 0.05, 1.0]))[:3]
    block = box_body("block", "furniture", "Box", (0.03, 0.03, 0.03), tuple(at))
    assert plan_at(scene, base).outcome == "success"
    assert plan_at(table_scene([block]), base).outcome == "arm_collision"


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
    assert a.grasps_free <= b.grasps_free
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
