"""Collision checks of the gripper without an arm: which grasps of the target it can reach and lift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.schemas.specification import MotionParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.collision import Bools, Hulls, Placed, hits, hulls_of
from datagen.workers.robots.gripper import Gripper

# Largest error of poses by inverse kinematics: 0.5 mm, and 0.5 degrees at the palm.
IK_SLACK_M = 0.0015
# Distance that the hand keeps from everything but the target while it is at the grasp.
HAND_MARGIN_M = 0.002
# Depth to which hand and target may overlap on the approach: convex parts are thicker than the object.
TOUCH_M = 0.002
LINE_STEP_M = 0.02
# The target leaves its support within this rise; contacts count only beyond it.
LIFT_OFF_M = 0.01


@dataclass(frozen=True, eq=False)
class Hand:
    """A gripper's parts; their owners are its bodies."""

    hulls: Hulls
    digest: str  # the gripper's
    gripper: Gripper

    def poses(self, T_tcp: F64, opening_m: F64) -> F64:
        """Poses (M, B, 4, 4) of the bodies, in the frame of the TCP's poses (M, 4, 4); openings (M,)."""
        if self.gripper.linkage is not None:
            return np.matmul(T_tcp[:, None], self.gripper.body_poses(opening_m))
        T = np.repeat(T_tcp[:, None], 3, axis=1)
        shift = T_tcp[:, :3, 1] * (opening_m / 2)[:, None]
        T[:, 1, :3, 3] += shift
        T[:, 2, :3, 3] -= shift
        return T


_hands: dict[str, Hand] = {}


def hand_of(gripper: Gripper) -> Hand:
    """The gripper's parts, ready for contacts; built once."""
    if gripper.digest not in _hands:
        _hands[gripper.digest] = Hand(hulls_of(gripper.body_parts_m), gripper.digest, gripper)
    return _hands[gripper.digest]


def line_offsets_m(length_m: float) -> F64:
    """Distances from 0 to `length_m`, both included, at most `LINE_STEP_M` apart."""
    return np.linspace(0.0, length_m, 1 + int(np.ceil(length_m / LINE_STEP_M - 1e-9)))


def backed(T_tcp: F64, back_m: float) -> F64:
    """TCP poses (..., 4, 4) drawn back against their direction of approach."""
    T = T_tcp.copy()
    T[..., :3, 3] -= T[..., :3, 2] * back_m
    return T


def raised(T_world: F64, rise_m: float) -> F64:
    """World poses (..., 4, 4) moved straight up."""
    T = T_world.copy()
    T[..., 2, 3] += rise_m
    return T


def free_grasps(
    hand: Hand, T_world_tcp: F64, opening_m: F64, around: Placed, target: Placed, params: MotionParams
) -> Bools:
    """Grasps (G,) that the hand can reach along the line from the pregrasp, and lift.

    `around` is all but the target: the hand keeps `HAND_MARGIN_M` from it, and `margin_m` at the
    pregrasp, where the arm's path ends. Fingers may touch the target on the approach.
    """
    free = np.ones(len(T_world_tcp), np.bool_)

    def keep(T: F64, still: Placed, margin_m: float) -> None:
        if len(still) == 0:
            return
        rows = np.flatnonzero(free)
        free[rows[hits(hand.hulls, hand.poses(T[rows], opening_m[rows]), still, margin_m)]] = False

    keep(T_world_tcp, around, HAND_MARGIN_M)
    keep(T_world_tcp, target, -TOUCH_M)
    for back_m in line_offsets_m(params.pregrasp_m)[:0:-1]:
        T, is_end = backed(T_world_tcp, float(back_m)), back_m == params.pregrasp_m
        keep(T, around, params.margin_m + IK_SLACK_M if is_end else HAND_MARGIN_M)
        keep(T, target, params.margin_m + IK_SLACK_M if is_end else -TOUCH_M)
    for rise_m in line_offsets_m(params.lift_m)[1:]:
        keep(raised(T_world_tcp, float(rise_m)), around, HAND_MARGIN_M)
    return free


def can_be_lifted(target: Hulls, T_world_target: F64, static: Placed, lift_m: float) -> bool:
    """Whether the target, moved straight up, stays clear of the house.

    The check leaves out the first `LIFT_OFF_M`, in which the target leaves its support, and the other
    objects, which it may push aside.
    """
    rises = line_offsets_m(lift_m)
    T = np.repeat(T_world_target[None, None], len(rises), axis=0)
    T[:, 0, 2, 3] += rises
    return not hits(target, T[rises > LIFT_OFF_M], static, -TOUCH_M, first_only=True).any()
