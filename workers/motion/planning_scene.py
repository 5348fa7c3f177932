"""A scene and a robot, prepared for planning from any base pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.schemas.specification import MotionParams
from datagen.workers.bases.clearance import STEP_M
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.grasps.grasp import GraspSet
from datagen.workers.motion.collision import (
    Bools,
    Hulls,
    Ints,
    Placed,
    hits,
    hulls_of,
    joined,
    object_hulls,
    place,
    place_object,
)
from datagen.workers.motion.forward_kinematics import ForwardKinematics, forward_kinematics
from datagen.workers.motion.grasp_filter import Hand, best_different, can_be_lifted, free_grasps, hand_of
from datagen.workers.motion.reach_table import ReachTable, reach_table
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes.scene import SettledScene

_PEDESTAL_SIDES = 16
_PEDESTAL_GAP_M = 0.02  # between the pedestal's top and the mount
ROOM_AROUND_M = 0.25  # how far elbows and the hand reach out beyond the TCP
_SAME_PART_M = 1e-4
# Deeper in another object than any settled one; settling allows 5 mm, by hulls of its own.
_SUNK_M = 0.01


@dataclass(frozen=True, eq=False)
class Moving:
    """A robot's shape for planning, built once a robot.

    Owners of `arm` are the frames of `kinematics`. The hand is not in it: it comes as `hand`, with its
    fingers as far apart as the grasp asks.
    """

    kinematics: ForwardKinematics
    arm: Hulls
    hand: Hand
    table: ReachTable


@dataclass(frozen=True, eq=False)
class PlanningScene:
    """A scene and a robot, ready for `plan_candidate`. Kept grasps come with both turns of the hand."""

    robot: Robot
    params: MotionParams
    moving: Moving
    static: Placed  # convex parts of the house around
    floor: Bools  # of the static parts, which are low enough to stand on
    objects: Placed  # the target's parts, then those of the other objects
    target_parts: int
    pedestal_m: F32 | None  # corners of its convex body in the base frame
    grasps_free: int  # of the whole GraspSet
    grasp: Ints  # (K,), row of the GraspSet
    T_world_tcp: F64  # (K, 4, 4)
    opening_m: F64  # (K,)


def prepare(
    scene: SettledScene,
    robot: Robot,
    grasps: GraspSet,
    params: MotionParams,
    max_grasps: int,
    base_radius_m: float,
    draw: int = 0,
) -> PlanningScene:
    """Place the scene's parts, and keep at most `max_grasps` good and different grasps the hand can take.

    `base_radius_m` is the radius of the pedestal of a robot that has no base of its own.
    """
    moving = moving_of(robot, draw)
    target, T_world_target = scene.models[0], scene.T_world_object[0]
    around_m = 2 * (robot.reach_m + ROOM_AROUND_M)
    static, floor = _static_around(scene, around_m)
    placed_target = place_object(target, T_world_target)
    others = [place_object(m, T) for m, T in zip(scene.models[1:], scene.T_world_object[1:], strict=True)]
    around = joined([static, *others])
    T_world_tcp = np.matmul(T_world_target, grasps.T_object_tcp)
    opening_m = grasps.opening_m.astype(np.float64)
    free = np.zeros(len(grasps), np.bool_)
    hulls = object_hulls(target)
    # A target within another thing can be held by nothing, whatever the hand alone may do there.
    is_sunk = (
        bool(hits(hulls, T_world_target[None, None], joined(others), -_SUNK_M).any()) if others else False
    )
    if not is_sunk and can_be_lifted(hulls, T_world_target, static, params.lift_m):
        free = free_grasps(moving.hand, T_world_tcp, opening_m, around, placed_target, params)
    rows = np.flatnonzero(free)
    kept = rows[best_different(T_world_tcp[rows], grasps.score[rows], max_grasps)]
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned = np.matmul(T_world_tcp[kept], half_turn)
    fits = free_grasps(moving.hand, turned, opening_m[kept], around, placed_target, params)
    grasp = np.concatenate([kept, kept[fits]])
    T = np.concatenate([T_world_tcp[kept], turned[fits]])
    return PlanningScene(
        robot,
        params,
        moving,
        static,
        floor,
        joined([placed_target, *others]),
        len(placed_target),
        _pedestal_m(robot, base_radius_m) if robot.base_radius_m is None else None,
        len(rows),
        grasp,
        T,
        opening_m[grasp],
    )


def moving_of(robot: Robot, draw: int = 0) -> Moving:
    """The robot's kinematics, shape and reach table."""
    kinematics = forward_kinematics(robot)
    T_tcp = kinematics.T_base_frame[-1]
    hand = robot.gripper.parts_at(robot.gripper.max_opening_m)
    parts = [
        () if _is_of_hand(parts, T, T_tcp, hand) else parts
        for parts, T in zip(robot.link_parts_m, kinematics.T_base_frame, strict=False)
    ]
    return Moving(kinematics, hulls_of(parts), hand_of(robot.gripper), reach_table(robot, kinematics, draw))


def pose_of_base(base_xy_m: F64, base_height_m: float, target_center_m: F64) -> F64:
    """World pose (4, 4) of the arm's mount at a base position (2,), its x axis turned to the target."""
    dx, dy = target_center_m[0] - base_xy_m[0], target_center_m[1] - base_xy_m[1]
    return yaw_pose(float(base_xy_m[0]), float(base_xy_m[1]), base_height_m, float(np.arctan2(dy, dx)))


def _is_of_hand(parts: tuple[F32, ...], T_base_link: F64, T_base_tcp: F64, hand: tuple[F32, ...]) -> bool:
    """Whether every part of a link is one of the open hand's, seen from the TCP with all joints at zero."""
    R = T_base_tcp[:3, :3]

    def box(points: F64) -> F64:
        return np.concatenate([points.min(axis=0), points.max(axis=0)])

    boxes = np.array([box(p.astype(np.float64)) for p in hand])
    for part in parts:
        in_base = part @ T_base_link[:3, :3].T + T_base_link[:3, 3]
        apart = np.abs(boxes - box((in_base - T_base_tcp[:3, 3]) @ R)).max(axis=1)
        if apart.min() > _SAME_PART_M:
            return False
    return len(parts) > 0


def _static_around(scene: SettledScene, around_m: float) -> tuple[Placed, Bools]:
    """The house's parts within a cube around the target, and which of them a base stands on."""
    center = scene.target_center_m
    parts = [
        part
        for body in scene.house.house.bodies
        for part in body.convex_parts_m
        if (part.min(axis=0) < center + around_m).all() and (part.max(axis=0) > center - around_m).all()
    ]
    static = place(parts)
    return static, static.high_m[:, 2] <= STEP_M


def _pedestal_m(robot: Robot, radius_m: float) -> F32 | None:
    """Corners (32, 3), base frame, of a prism from the floor to just below the mount."""
    top_m, bottom_m = -_PEDESTAL_GAP_M, -robot.base_height_m
    if top_m <= bottom_m or radius_m <= 0:
        return None
    angles = 2 * np.pi * np.arange(_PEDESTAL_SIDES) / _PEDESTAL_SIDES
    ring = radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rows = [np.column_stack([ring, np.full(_PEDESTAL_SIDES, z)]) for z in (bottom_m, top_m)]
    return np.concatenate(rows).astype(np.float32)
