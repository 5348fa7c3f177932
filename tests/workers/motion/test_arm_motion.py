"""Configurations of robots in scenes against pinocchio and coal."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.arm_model import arm_of, on_pedestal
from datagen.workers.motion.arm_motion import NO_HAND, Search, is_blocked
from datagen.workers.motion.hand_motion import NOTHING, TARGET
from datagen.workers.motion.plan_candidate import _Search  # pyright: ignore
from datagen.workers.motion.planning_scene import PlanningScene
from tests.workers.motion.plan_checks import SceneJudge
from tests.workers.motion.tables import PARAMS, arm, front_base, prepared, table_scene
from tests.workers.robots.robots_under_test import CASES, Case, opened
from tests.workers.worlds import box_body, box_model

CLUTTER = [
    (box_model("carton", (0.08, 0.06, 0.2)), 0.12, -0.1),
    (box_model("low", (0.1, 0.1, 0.05)), -0.2, -0.2),
]


def search_at(ready: PlanningScene, base: F64) -> Search:
    return _Search(ready, np.ascontiguousarray(base[:3]), np.random.default_rng(0)).compiled


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("count", [24, pytest.param(1700, marks=pytest.mark.slow)])
def test_configurations_are_blocked_where_the_judge_says_so(case: Case, count: int) -> None:
    robot = opened(case)
    scene = table_scene(clutter=CLUTTER)
    ready, base = prepared(scene, robot), front_base(scene, robot, away_m=max(0.45, 0.5 * robot.reach_m))
    at, judge, rng = search_at(ready, base), SceneJudge(scene, robot, base), np.random.default_rng(4)
    openings, margin_m, seen = ready.around.opening_m, PARAMS.margin_m, list[bool]()
    for k in range(count):
        a, b = robot.homes_rad[rng.integers(0, len(robot.homes_rad), 2)]
        q = a + rng.uniform() * (b - a) + rng.normal(0, 0.5, len(a))
        q = np.clip(q, robot.q_lower_rad, robot.q_upper_rad)
        row, with_target = int(rng.integers(len(openings))), bool(k % 2)
        own_m, arm_m = judge.own_gap_m(q), judge.arm_gap_m(q, with_target) - margin_m
        hand_m = judge.hand_gap_m(q, float(openings[row]), with_target) - margin_m
        ignored = NOTHING if with_target else TARGET
        if min(map(abs, (own_m, arm_m, hand_m))) > 1e-5:
            assert is_blocked(at, q, NO_HAND, ignored) == (min(own_m, arm_m) < 0)
            assert is_blocked(at, q, row, ignored) == (min(own_m, arm_m, hand_m) < 0)
            seen.append(min(own_m, arm_m, hand_m) < 0)
    assert 0 < sum(seen) < len(seen)


def test_the_pedestal_is_an_obstacle_for_all_but_the_first_links() -> None:
    scene, robot = table_scene(), arm()
    base = front_base(scene, away_m=0.9)
    T = np.diag([1.0, -1.0, -1.0, 1.0])  # down, beside the pedestal and below the mount
    T[:3, 3] = (0.4, 0.0, -0.1)
    q = next(q for q in (robot.ik(T, home) for home in robot.homes_rad) if q is not None)
    plain, on_top = arm_of(robot), on_pedestal(arm_of(robot), robot.base_height_m, 0.2)
    more = on_top.own_pairs[len(plain.own_pairs) :]
    assert set(more[:, 1]) == {len(plain.own.owner)}
    wanted = np.flatnonzero(robot.tree.frame_joint[plain.own.owner] > 0)
    np.testing.assert_array_equal(more[:, 0], wanted)
    for radius_m, touches in ((0.1, False), (0.4, True)):
        ready = prepared(scene, robot, pedestal_m=radius_m)
        at = search_at(ready, base)
        assert is_blocked(at, q, 0, NOTHING) == touches
        assert not all(is_blocked(at, home, 0, NOTHING) for home in robot.homes_rad)


def test_what_a_mount_stands_on_is_no_obstacle_for_what_stands_on_it() -> None:
    """A plate under the base: it stops neither links that stand nor a base that turns, if it is low."""
    robot = next(opened(c.values[0]) for c in CASES if c.values and c.values[0][0] == "stretch3")
    for height_m, is_stuck in ((0.015, False), (0.06, True)):
        plain = table_scene()
        base = front_base(plain, robot, away_m=0.8)
        plate = box_body("plate", "furniture", "Rug", (0.8, 0.8, height_m), (*base[:2, 3], height_m / 2))
        scene = table_scene([plate])
        at, judge = search_at(prepared(scene, robot), base), SceneJudge(scene, robot, base)
        blocked = [is_blocked(at, q, 0, NOTHING) for q in robot.homes_rad]
        wanted = [judge.arm_gap_m(q, True) < PARAMS.margin_m for q in robot.homes_rad]
        assert blocked == wanted and any(blocked) == is_stuck
