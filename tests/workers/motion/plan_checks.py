"""A robot in a scene, and its plans, judged by pinocchio and coal, not by what planned them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from datagen.schemas.specification import MotionParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion import MotionPlan
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from tests.workers.motion.tables import PARAMS, PEDESTAL_M
from tests.workers.oracles import Hulls, TreeOracle, off_goal

_EXACT_M = 1e-5
_FLOOR_M = 0.02  # a base stands on parts that are not higher
_TOUCH_M = 0.005  # the hand's skin and errors of poses, which the target may overlap with
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


class SceneJudge:
    """Distances of a robot at a base pose (4, 4) in a scene."""

    def __init__(
        self, scene: SettledScene, robot: Robot, T_world_base: F64, params: MotionParams = PARAMS
    ) -> None:
        self.params = params
        self.scene, self.robot, self.T_world_base = scene, robot, T_world_base
        self.tree = TreeOracle(robot.tree)
        placed = [
            [part @ T[:3, :3].T + T[:3, 3] for part in model.convex_parts_m]
            for model, T in zip(scene.models, scene.T_world_object, strict=True)
        ]
        static = [part for body in scene.house.house.bodies for part in body.convex_parts_m]
        self.floor = Hulls([p for p in static if p[:, 2].max() <= _FLOOR_M])
        self.rest = Hulls([p for p in static if p[:, 2].max() > _FLOOR_M])
        self.target, self.others = Hulls(placed[0]), Hulls([p for parts in placed[1:] for p in parts])
        links = robot.link_parts_m
        self.links = [Hulls(parts) for parts in links]
        # Fingers are watched as one hull each, against the robot itself.
        first = robot.first_hand_link
        hulls = [(np.concatenate(p),) if k > first and p else p for k, p in enumerate(links)]
        self.own = [Hulls(parts) for parts in hulls]
        self.moves = robot.tree.frame_joint >= 0
        if robot.base_radius_m is None:
            circle = np.exp(2j * np.pi * np.arange(16) / 16) * PEDESTAL_M
            ring = np.column_stack([circle.real, circle.imag])
            ends = [np.column_stack([ring, np.full(16, z)]) for z in (-robot.base_height_m, -0.02)]
            self.pedestal = Hulls([np.concatenate(ends)])

    def own_gap_m(self, q: F64) -> float:
        """Smallest distance of links that must not touch, and of the pedestal to all links but the first."""
        T, robot = self.tree.frames(q), self.robot
        gaps = [self.own[a].gaps_m(T[a], self.own[b], T[b], 0.0) for a, b in robot.self_pairs]
        if robot.base_radius_m is None:
            beyond = np.flatnonzero(robot.tree.frame_joint[:-1] > 0)
            gaps += [self.own[k].gaps_m(T[k], self.pedestal, np.eye(4), 0.0) for k in beyond]
        return min((g.min() for g in gaps if g.size), default=np.inf)

    def arm_gap_m(self, q: F64, with_target: bool, far_m: float = 0.05) -> float:
        """Smallest distance of the moving links, without the hand, to the scene."""
        T, robot, gap_m = self.T_world_base @ self.tree.frames(q), self.robot, far_m
        for k in range(robot.first_hand_link):
            if self.moves[k]:
                gap_m = min(gap_m, self.gap_m(self.links[k], T[k], with_target, not robot.is_base[k], far_m))
        return gap_m

    def hand_gap_m(self, q: F64, opening_m: float, with_target: bool, far_m: float = 0.05) -> float:
        """Smallest distance of the hand at an opening to the scene."""
        hand = Hulls(self.robot.gripper.parts_at(opening_m))
        T = self.T_world_base @ self.tree.frames(q)[-1]
        return self.gap_m(hand, T, with_target, True, far_m)

    def fixed_gap_m(self) -> float:
        """Smallest distance of links that no joint moves to all but the floor."""
        T = self.T_world_base @ self.tree.frames(self.robot.homes_rad[0])
        rows = [k for k in range(self.robot.first_hand_link) if not self.moves[k]]
        return min((self.gap_m(self.links[k], T[k], True, False, 0.0) for k in rows), default=np.inf)

    def gap_m(self, body: Hulls, T: F64, with_target: bool, with_floor: bool, far_m: float) -> float:
        groups = [self.rest, self.others, *[self.target] * with_target, *[self.floor] * with_floor]
        gaps = [body.gaps_m(T, group, np.eye(4), far_m) for group in groups]
        return min((g.min() for g in gaps if g.size), default=np.inf)

    def check(self, plan: MotionPlan, T_object_tcp: F64 | None) -> None:
        """Everything that a plan promises, at configurations a step apart; `T_object_tcp` is its grasp."""
        robot, params, margin_m = self.robot, self.params, self.params.margin_m - _EXACT_M
        weight = np.where(robot.slides, 2.0, 1.0)
        reach, approach, lift = plan.q_reach_rad, plan.q_approach_rad, plan.q_lift_rad
        np.testing.assert_array_equal(reach[0], robot.homes_rad[plan.home])
        np.testing.assert_array_equal(reach[-1], approach[0])
        np.testing.assert_array_equal(approach[-1], lift[0])
        steps = np.linalg.norm(np.diff(reach, axis=0) * weight, axis=1)
        assert steps.max() <= params.check_step_rad + 1e-9
        length = np.linalg.norm(np.diff(np.concatenate([reach, approach[1:]]), axis=0) * weight, axis=1).sum()
        assert abs(plan.length_rad - length) < 1e-9
        for rows in (approach, lift):
            assert (np.abs(np.diff(rows, axis=0)) * weight).max() <= params.max_joint_jump_rad
        for q in np.concatenate([reach, approach, lift]):
            assert ((q >= robot.q_lower_rad) & (q <= robot.q_upper_rad)).all()
        assert self.fixed_gap_m() >= -_EXACT_M
        for rows, is_reach, with_target in (
            (reach, True, True),
            (approach, False, True),
            (lift, False, False),
        ):
            for q in dense(rows, weight, params.check_step_rad):
                assert self.own_gap_m(q) >= -_EXACT_M
                assert self.arm_gap_m(q, with_target) >= margin_m
                if is_reach:
                    assert self.hand_gap_m(q, plan.opening_m, True) >= margin_m
            for q in rows:
                assert self.hand_gap_m(q, plan.opening_m, False) > 0.0
        for q in approach:
            assert self.hand_gap_m(q, plan.opening_m, True) > -_TOUCH_M
        self.check_lines(plan, T_object_tcp)
        some = [reach[round(k)] for k in np.linspace(0, len(reach) - 1, min(8, len(reach)))]
        clearance_m = min(
            min(self.arm_gap_m(q, True, 1.0), self.hand_gap_m(q, plan.opening_m, True, 1.0)) for q in some
        )
        assert abs(plan.clearance_m - clearance_m) < _EXACT_M

    def check_lines(self, plan: MotionPlan, T_object_tcp: F64 | None) -> None:
        """The hand comes to its grasp along its approach, and goes straight up with the target."""
        base, target = self.T_world_base, self.scene.T_world_object[0]
        reached = base @ self.tree.frames(plan.q_lift_rad[0])[-1]
        wanted = reached if T_object_tcp is None else target @ T_object_tcp
        slack_m = 0.0015 if T_object_tcp is None else 1e-9  # of a grasp that is known by its solution alone
        off = [off_goal(reached, wanted @ turn) for turn in (np.eye(4), HALF_TURN)]
        assert any(off_m < 0.0005 + 1e-9 and off_rad < np.radians(0.5) + 1e-9 for off_m, off_rad in off)
        for rows, direction, length_m in (
            (plan.q_approach_rad[::-1], -wanted[:3, 2], self.params.pregrasp_m),
            (plan.q_lift_rad, np.array([0, 0, 1]), self.params.lift_m),
        ):
            several = [a + f * (b - a) for a, b in pairwise(rows) for f in (0, 0.25, 0.5, 0.75)]
            T = np.stack([base @ self.tree.frames(q)[-1] for q in [*several, rows[-1]]])
            way = T[:, :3, 3] - wanted[:3, 3]
            off_m = np.linalg.norm(way - np.outer(way @ direction, direction), axis=1)
            assert off_m.max() < 0.002 + slack_m and off_m[::4].max() < 0.0005 + slack_m
            assert abs(way[-1] @ direction - length_m) < 0.0005 + slack_m
            assert len(rows) == 1 + np.ceil(length_m / 0.02)
        # What is lifted leaves the house, and touches nothing of it on the way up.
        parts, up = Hulls(self.scene.models[0].convex_parts_m), T[4::4]
        for T_tcp in up:
            T_target = T_tcp @ inverse(reached) @ target
            assert parts.gaps_m(T_target, self.rest, np.eye(4), 0.0).min() > -_TOUCH_M


def dense(rows: F64, weight: F64, step: float) -> F64:
    """Rows on the polyline at most a step apart."""
    out = [rows[:1]]
    for a, b in pairwise(rows):
        n = max(1, int(np.ceil(np.linalg.norm((b - a) * weight) / step - 1e-9)))
        out.append(a + (b - a) * (np.arange(1, n + 1) / n)[:, None])
    return np.concatenate(out)
