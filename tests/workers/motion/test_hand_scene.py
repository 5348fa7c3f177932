"""The hand alone among things, what robots of one hand share, and the grasps searched for a scene alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from datagen.workers.content_cache import CacheFolder
from datagen.workers.geometry.mesh import F64
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.grasps.search import HandClearance
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.contacts import parts_of
from datagen.workers.motion import PlanReport, planning_scene
from datagen.workers.motion.arm_model import TOUCH_M, core_of, hand_of
from datagen.workers.motion.hand_motion import OTHER, TARGET, Poses, Room, clear_poses, free_poses, points_on
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.motion.planning_scene import PlanningScene, hand_scene, limits_of, still_of
from datagen.workers.robots.gripper import Gripper
from datagen.workers.scenes import SettledScene
from tests.workers.motion.plan_checks import HALF_TURN
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
from tests.workers.oracles import Hulls
from tests.workers.robots.robots_under_test import CASES, Case, opened
from tests.workers.worlds import box_model, box_vertices

FROM_ABOVE = np.flatnonzero(box_grasps().T_object_tcp[:, 2, 2] < -0.5)
FROM_SIDES = np.flatnonzero(box_grasps().T_object_tcp[:, 2, 2] > -0.5)
LIMITS = limits_of(PARAMS)
OPENINGS_M = np.array([0.05, 0.064])


def freed(gripper: Gripper, boxes: list[np.ndarray], target: np.ndarray, T: F64, opening: F64) -> Poses:
    """The state of poses (K, 4, 4) of the hand among boxes around a target, all in the target's frame."""
    still = still_of([*boxes, target], [int(OTHER)] * len(boxes) + [int(TARGET)])
    room = in_memory(Room(still, np.arange(len(still.kind))))
    hand, limits = in_memory(hand_of(gripper, OPENINGS_M)), in_memory(LIMITS)
    poses = Poses.unknown(np.ascontiguousarray(T[:, :3]), opening)
    free = free_poses(hand, room, limits, in_memory(poses), 0, len(T))
    assert free == (poses.is_free > 0).sum()
    clears = clear_poses(hand, room, limits, poses.T_world_tcp, opening)
    np.testing.assert_array_equal(clears, poses.clears > 0)
    return poses


def free_with(
    *boxes: tuple[tuple[float, float, float], tuple[float, float, float]],
    target_m: tuple[float, float, float] = BOX_M,
) -> np.ndarray:
    """Which of the box's grasps stay free among boxes given by size and centre in the target's frame."""
    grasps, around = box_grasps(), [box_vertices(size, centre) for size, centre in boxes]
    opening = np.ones(len(grasps), np.int64)
    return freed(arm().gripper, around, box_vertices(target_m), grasps.T_object_tcp, opening).is_free > 0


def test_neighbours_block_grasps() -> None:
    assert free_with().all()
    approach = box_grasps().T_object_tcp[:, :3, 2]
    above = free_with(((0.3, 0.3, 0.02), (0, 0, 0.2)))
    assert not above[approach[:, 2] < -0.5].any()
    assert above[approach[:, 2] > -0.5].all()
    # The hand of a grasp along +x comes from -x.
    beside = free_with(((0.02, 0.3, 0.3), (-0.15, 0, 0)))
    assert not beside[approach[:, 0] > 0.5].any()
    assert beside[approach[:, 0] < -0.5].all()
    assert not free_with(((2.0, 2.0, 2.0), (0, 0, 0))).any()  # the whole hand within a block


def test_the_hand_keeps_its_distance_at_the_pregrasp() -> None:
    """A plate behind the hand, 8 cm before its grasps along x: 5 mm, and what the arm may be off."""
    along_x = box_grasps().T_object_tcp[:, 0, 2] > 0.5
    back_m = np.concatenate(arm().gripper.palm_parts_m)[:, 2].min() - PARAMS.pregrasp_m
    for gap_m, is_free in ((0.004, False), (0.006, False), (0.007, True)):
        plate = free_with(((0.02, 0.3, 0.3), (back_m - gap_m - 0.01, 0, 0)))
        assert (plate[along_x] == is_free).all()


def test_fingers_do_not_fit_around_what_is_wider_than_their_opening() -> None:
    assert not free_with(target_m=(0.09, 0.09, 0.12)).any()


@pytest.mark.parametrize("name", ["panda", "fetch"])
def test_the_hand_is_free_where_coal_says_so(name: str) -> None:
    """At every point of its approach and its lift, at the distances that each of them asks for."""
    gripper = next(opened(c.values[0]) for c in CASES if c.values[0][0] == name).gripper
    rng, grasps, target = np.random.default_rng(3), box_grasps(), box_vertices(BOX_M)
    T = np.repeat(grasps.T_object_tcp, 6, axis=0)
    T[:, :3, 3] += rng.uniform(-0.02, 0.02, (len(T), 3))
    opening = rng.integers(0, 2, len(T))
    offsets = rng.uniform(-0.2, 0.2, (3, 3)) + [[0, 0, 0.1]]
    boxes = [box_vertices((0.03, 0.04, 0.05), tuple(c)) for c in offsets]
    states, rest, aim = freed(gripper, boxes, target, T, opening), Hulls(boxes), Hulls([target])
    far_m = PARAMS.margin_m + 0.0015
    lines = [(b, 0.0, 0.002) for b in np.linspace(0, 0.08, 5)[:-1]] + [(0.08, 0.0, far_m)]
    lines += [(0.0, r, 0.002) for r in np.linspace(0, 0.1, 6)]
    for k, pose in enumerate(T):
        whole = gripper.parts_at(float(OPENINGS_M[opening[k]]))
        cores = [core_of(part) for part in whole]
        points = np.concatenate([core[:1] for core in cores if (core == core[0]).all()] or [np.zeros((0, 3))])
        hand, core = Hulls(whole), Hulls([core for core in cores if (core != core[0]).any()])
        gap_m = clears_m = 1.0
        for back_m, rise_m, margin_m in lines:
            at = pose.copy()
            at[:3, 3] += -back_m * pose[:3, 2] + np.array([0, 0, rise_m])
            gap_m = min(gap_m, hand.gaps_m(at, rest, np.eye(4)).min() - margin_m)
            if rise_m == 0.0:
                body, least_m = (hand, far_m) if back_m == 0.08 else (core, 0.0)
                clears_m = min(clears_m, body.gaps_m(at, aim, np.eye(4)).min() - least_m)
                if back_m != 0.08 and len(points):  # middles of thin parts
                    clears_m = min(clears_m, -depth_m(target, points @ at[:3, :3].T + at[:3, 3]).max())
        if min(abs(gap_m), abs(clears_m)) > 1e-5:
            assert (states.clears[k] > 0) == (clears_m > 0)
            assert (states.is_free[k] > 0) == (clears_m > 0 and gap_m > 0)
    assert 0 < (states.is_free > 0).sum() < (states.clears > 0).sum() < len(T)


@pytest.mark.parametrize("case", CASES)
def test_fingers_follow_the_opening(case: Case) -> None:
    robot = opened(case)
    openings = np.linspace(0.01, robot.gripper.max_opening_m, 4)[:-1]
    whole = hand_of(robot.gripper, openings).whole
    count, corners = len(whole.owner), whole.first[-1]
    for s, opening_m in enumerate([*openings, robot.gripper.max_opening_m]):
        parts = robot.gripper.parts_at(float(opening_m))
        assert len(parts) == count
        for p, part in enumerate(parts):
            points = whole.points_m[s * corners + whole.first[p] : s * corners + whole.first[p + 1]]
            np.testing.assert_allclose(np.unique(points, axis=0), np.unique(part, axis=0), atol=1e-6)
            box = whole.center_m[s * count + p], whole.half_m[s * count + p]
            np.testing.assert_allclose(box[0] - box[1], part.min(axis=0), atol=1e-6)
            np.testing.assert_allclose(box[0] + box[1], part.max(axis=0), atol=1e-6)
    assert len(whole.points_m) == 4 * corners


def test_a_core_is_what_lies_inside_its_part() -> None:
    rng = np.random.default_rng(0)
    for part in (box_vertices((0.02, 0.05, 0.03)), rng.normal(size=(12, 3)).astype(np.float32) * 0.02):
        core, points = core_of(part), rng.dirichlet(np.full(len(part), 0.3), 300) @ part
        assert abs(depth_m(part, core).min() - TOUCH_M) < 1e-7
        np.testing.assert_array_equal(depth_m(core, points) > 0, depth_m(part, points) > TOUCH_M)
    thin = core_of(box_vertices((0.003, 0.05, 0.03), (1.0, 0.0, 0.0)))
    np.testing.assert_allclose(thin, np.tile([1.0, 0.0, 0.0], (4, 1)), atol=1e-7)


def depth_m(corners: F64, points: F64) -> F64:
    """How deep points (N, 3) lie in a convex part (N,), negative outside."""
    planes = ConvexHull(np.asarray(corners, np.float64)).equations
    return -(points @ planes[:, :3].T + planes[:, 3]).max(axis=1)


def test_lines_are_walked_in_small_steps() -> None:
    assert [points_on(length_m, 0.02) for length_m in (0.0, 0.01, 0.02, 0.08, 0.1, 0.105)] == [
        1,
        2,
        2,
        5,
        6,
        7,
    ]


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
    assert around.grasp[: around.first].tolist() == [0, 0, 1, 1, 2, 2] and around.grasps_free == 3
    assert (around.arrays.is_free[: around.first] == 1).all()
    assert set(around.grasp[around.first :].tolist()) == set(range(3, len(box_grasps())))
    assert not around.arrays.is_free[around.first :].any()  # checked on first use
    T = around.arrays.T_world_tcp
    wanted = table_scene().T_world_object[0] @ box_grasps().T_object_tcp[around.grasp]
    np.testing.assert_allclose(T[::2], wanted[::2, :3], atol=1e-12)
    np.testing.assert_allclose(T[1::2], (wanted[1::2] @ HALF_TURN)[:, :3], atol=1e-12)


def test_all_grasps_are_checked_where_the_first_are_blocked() -> None:
    """Those from above come first here, and a shelf takes them."""
    assert (np.diff(box_grasps().T_object_tcp[:, 2, 2]) >= 0).all()
    some = prepared(below_a_shelf(), per_scene=len(FROM_ABOVE))
    assert some.around.grasps_free == len(FROM_SIDES)
    assert plan_at(some, below_a_shelf()).outcome == "success"
    every, rows = box_grasps(), FROM_ABOVE
    from_above = GraspSet(every.T_object_tcp[rows], every.opening_m[rows], every.score[rows])
    none = prepared(below_a_shelf(), grasps=from_above)
    assert none.around.grasps_free == 0 and plan_at(none, below_a_shelf()).outcome == "no_grasp"


def test_a_candidate_tries_other_grasps_where_the_first_fail() -> None:
    """With how many a scene is looked at first decides nothing but the cost."""
    scene = table_scene()
    bases = [front_base(scene, dx_m=dx, away_m=d) for dx in (-0.3, 0.0, 0.3) for d in (0.45, 0.65, 0.75)]
    few, all_of_them = (prepared(scene, per_scene=n) for n in (1, 40))
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
    around = hand_scene(scene, gripper, grasps, LIMITS, 40, 2.0)
    every = np.repeat(T, 2, axis=0)
    every[1::2] = every[1::2] @ HALF_TURN
    fits = HandClearance(scene.models[0].convex_parts_m, gripper).free(every, np.full(4, 0.064))
    assert fits.tolist() == [False, True, True, False]
    world = np.matmul(scene.T_world_object[0], every[fits])[:, :3]
    np.testing.assert_allclose(around.arrays.T_world_tcp, world, atol=1e-12)
    assert (around.arrays.is_free > 0).all()


def test_a_stored_core_is_the_computed_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning_scene, "_CORES", CacheFolder("cores-again", 9))
    monkeypatch.setattr(planning_scene, "in_memory", lambda parts: parts)
    boxes = [box_model("box", BOX_M) for _ in range(2)]
    computed = parts_of([[core_of(part, 0.01) for part in boxes[0].convex_parts_m]])
    for box in boxes:
        for found, expected in zip(planning_scene._core(box, 0.01), computed, strict=True):
            np.testing.assert_array_equal(found, expected)
        monkeypatch.setattr(planning_scene, "core_of", None)  # the second is read
