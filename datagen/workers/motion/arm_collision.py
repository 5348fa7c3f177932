"""Collision checks of an arm at one base pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.collision import Bools, Hulls, Ints, Placed, hits, joined, place, smallest_gap_m
from datagen.workers.motion.planning_scene import ROOM_AROUND_M, PlanningScene

_FAR_M = 1.0  # larger clearances are not computed


@dataclass(eq=False)
class Surroundings:
    """The parts around one base pose of a planning scene. Links that no joint moves are not in `arm`."""

    scene: PlanningScene
    T_world_base: F64  # (4, 4)
    near: Placed
    is_target: Bools  # near parts that are the target's
    arm: Hulls
    arm_may_touch: Bools  # (arm's parts, near parts)
    hand_may_touch: Bools  # (hand's parts, near parts)
    is_base_stuck: bool  # a link that no joint moves collides

    def first_blocked(self, q_rad: F64, opening_m: float) -> int:
        """The first of M joint vectors (M, A) at which the arm or the hand collides, or M."""
        T = self._frames(q_rad)
        margin_m = self.scene.params.margin_m
        end = _first(hits(self.arm, T, self.near, margin_m, self.arm_may_touch, True))
        hand = self.scene.moving.hand
        T_hand = hand.poses(T[:end, -1], np.full(end, opening_m))
        end = _first(hits(hand.hulls, T_hand, self.near, margin_m, self.hand_may_touch, True))
        return self._first_self_collision(q_rad[:end])

    def blocked(self, q_rad: F64, opening_m: F64 | None) -> Bools:
        """Whether the arm, with openings (M,) also the hand, collides at each of M joint vectors (M, A)."""
        T, margin_m = self._frames(q_rad), self.scene.params.margin_m
        found = hits(self.arm, T, self.near, margin_m, self.arm_may_touch)
        if opening_m is not None:
            hand, left = self.scene.moving.hand, np.flatnonzero(~found)
            T_hand = hand.poses(T[left, -1], opening_m[left])
            found[left] = hits(hand.hulls, T_hand, self.near, margin_m, self.hand_may_touch)
        for k in np.flatnonzero(~found):
            found[k] = self.scene.robot.collides_itself(q_rad[k])
        return found

    def first_arm_blocked(self, q_rad: F64, is_target_held: bool) -> int:
        """As `first_blocked` for the arm without the hand, whose line is known to be free."""
        may_touch = self.arm_may_touch | self.is_target if is_target_held else self.arm_may_touch
        T = self._frames(q_rad)
        end = _first(hits(self.arm, T, self.near, self.scene.params.margin_m, may_touch, True))
        return self._first_self_collision(q_rad[:end])

    @cached_property
    def free_homes(self) -> Ints:
        """Rows of the robot's tucked poses that are free here with the hand open."""
        homes = self.scene.robot.homes_rad
        T, hand, margin_m = self._frames(homes), self.scene.moving.hand, self.scene.params.margin_m
        T_hand = hand.poses(T[:, -1], np.full(len(T), self.scene.robot.gripper.max_opening_m))
        blocked = hits(self.arm, T, self.near, margin_m, self.arm_may_touch)
        blocked |= hits(hand.hulls, T_hand, self.near, margin_m, self.hand_may_touch)
        return np.flatnonzero(~blocked)

    def clearance_m(self, q_rad: F64, opening_m: float) -> float:
        """Smallest distance from arm and hand to the near parts over joint vectors (M, A), at most 1 m."""
        T = self._frames(q_rad)
        hand = self.scene.moving.hand
        T_hand = hand.poses(T[:, -1], np.full(len(T), opening_m))
        gap_m = smallest_gap_m(hand.hulls, T_hand, self.near, _FAR_M, self.hand_may_touch)
        return smallest_gap_m(self.arm, T, self.near, gap_m, self.arm_may_touch)

    def _frames(self, q_rad: F64) -> F64:
        return np.matmul(self.T_world_base, self.scene.moving.kinematics.poses(q_rad))

    def _first_self_collision(self, q_rad: F64) -> int:
        """The first of M joint vectors (M, A) at which the arm touches itself, or M."""
        for k, q in enumerate(q_rad):
            if self.scene.robot.collides_itself(q):
                return k
        return len(q_rad)


def surroundings(scene: PlanningScene, T_world_base: F64) -> Surroundings:
    """The parts within the arm's reach at a base pose (4, 4)."""
    robot, moving = scene.robot, scene.moving
    reach_m = robot.reach_m + ROOM_AROUND_M
    center_m = T_world_base[:3, :3] @ robot.shoulder_m + T_world_base[:3, 3]
    low_m, high_m = center_m - reach_m, center_m + reach_m
    around = scene.around
    static = around.static.within(low_m, high_m)
    objects = around.objects.within(low_m, high_m)
    groups = [around.static.rows(static), around.objects.rows(objects)]
    floor = np.concatenate([around.floor[static], np.zeros(len(objects), np.bool_)])
    is_target = np.concatenate([np.zeros(len(static), np.bool_), objects < around.target_parts])
    T_base = np.matmul(T_world_base, moving.kinematics.T_base_frame)[None]
    near = joined(groups)
    may_touch = np.broadcast_to(floor, (len(moving.fixed), len(floor)))
    is_base_stuck = bool(hits(moving.fixed, T_base, near, 0.0, may_touch).any())
    arm_may_touch = moving.stands[:, None] & floor
    if scene.pedestal_m is not None:
        pedestal = place([scene.pedestal_m @ T_world_base[:3, :3].T + T_world_base[:3, 3]])
        near = joined([near, pedestal])
        is_target = np.append(is_target, False)
        # Parts that only the first joint moves turn on the pedestal and may touch it.
        arm_may_touch = np.column_stack([arm_may_touch, moving.arm_depth == 1])
    hand_may_touch = np.zeros((len(moving.hand.hulls), len(near)), np.bool_)
    return Surroundings(
        scene, T_world_base, near, is_target, moving.arm, arm_may_touch, hand_may_touch, is_base_stuck
    )


def _first(found: Bools) -> int:
    return int(np.argmax(found)) if found.any() else len(found)
