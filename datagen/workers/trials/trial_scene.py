"""Moving bodies of a robot and the geometry around it, shared by all trials in one scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F32, F64, transformed_parts
from datagen.workers.geometry.planar import prism_corners, unit_circle
from datagen.workers.geometry.transforms import translation
from datagen.workers.objects.part_merging import merge_parts
from datagen.workers.robots.links import LinkBody
from datagen.workers.robots.robot import Robot
from datagen.workers.robots.urdf import Joint, rotation_rpy, rpy_rotation
from datagen.workers.scenes import SettledScene
from datagen.workers.trials import Disturbance

# Bodies without mass and shapes still need a little, at the joint.
_LEAST_MASS_KG, _LEAST_INERTIA_KGM2 = 1e-3, 1e-6
_LIGHTEST_FINGER_KG = 0.02


@dataclass(frozen=True, eq=False)
class MovingBody:
    """All links between one joint that moves and the next, as one rigid body.

    Its frame is that of the joint's child link. Body 0 is fixed to the base and has no joint.
    """

    parent: int  # -1 for body 0
    joint: str
    kind: Literal["revolute", "prismatic"]
    T_parent_joint: F64  # (4, 4), joint frame, x along the axis, in the parent's frame
    T_body_joint: F64  # (4, 4), the same frame in this body's
    lower: float
    upper: float
    parts_m: tuple[F32, ...]  # convex, body frame
    mass_kg: float  # 0 where the URDF has none: physics then takes that of the parts
    T_body_principal: F64  # (4, 4), centre of mass and principal axes
    inertia_kgm2: F64  # (3,), along them


def articulation_of(robot: Robot, opening_m: float = 0.0) -> tuple[MovingBody, ...]:
    """The bodies of a robot: body 0, those that the arm's joints move, then the two fingers.

    Fingers that turn slide here, in the posture that they have at an opening.
    """
    assembly, count = robot.assembly, len(robot.assembly.arm)
    arm, palm, fingers = (
        assembly.bodies[: count + 1],
        assembly.bodies[count + 1],
        assembly.bodies[count + 2 :],
    )
    T_palm = _rounded(assembly.palm.T_parent_child)
    bodies = [_body([(arm[0], np.eye(4))], -1, None, np.eye(4))]
    for k, joint in enumerate(assembly.arm):
        carried = [(palm, T_palm)] if k == count - 1 else []
        T = _rounded(joint.T_parent_child)
        bodies.append(_body([(arm[k + 1], np.eye(4)), *carried], k, joint, T))
    if robot.gripper.linkage is not None:
        T_last_tcp = assembly.palm.T_parent_child @ assembly.hand.T_palm_tcp
        for side, parts in zip((1.0, -1.0), robot.gripper.fingers_near(opening_m), strict=True):
            bodies.append(_sliding_finger(robot, parts, side, count, T_last_tcp, fingers))
        return tuple(bodies)
    open_m = robot.gripper.max_opening_m / 2
    for body, joint in zip(fingers, assembly.hand.joints, strict=True):
        if not joint.lower <= 0.0 < open_m <= joint.upper:  # the file's range, or a driver's, replaces it
            joint = replace(joint, lower=0.0, upper=open_m)
        bodies.append(_body([(body, np.eye(4))], count, joint, T_palm @ _rounded(joint.T_parent_child)))
    return tuple(bodies)


def _sliding_finger(
    robot: Robot,
    parts: tuple[F32, ...],
    side: float,
    parent: int,
    T_last_tcp: F64,
    links: tuple[LinkBody, ...],
) -> MovingBody:
    """A finger as one body that slides along y of the TCP, with half the mass of the hand's moving links."""
    axis, mass = np.array([0.0, side, 0.0]), sum(link.inertial.mass_kg for link in links if link.inertial) / 2
    T_body_joint = np.eye(4)
    T_body_joint[:3, :3] = _x_onto(axis)
    T_principal = translation(*np.concatenate(parts).mean(axis=0).tolist())
    return MovingBody(
        parent, f"finger{side:+.0f}", "prismatic", T_last_tcp @ T_body_joint, T_body_joint, 0.0,
        robot.gripper.max_opening_m / 2, parts, max(mass, _LIGHTEST_FINGER_KG), T_principal, np.full(3, 1e-4),
    )  # fmt: skip


def _rounded(T: F64) -> F64:
    """A pose (4, 4) with its rotation as its URDF would give it: physics depends on the last bits."""
    out = T.copy()
    out[:3, :3] = rpy_rotation(rotation_rpy(T[:3, :3]))
    return out


def _body(
    rigid: list[tuple[LinkBody, F64]], parent: int, joint: Joint | None, T_parent_child: F64
) -> MovingBody:
    """The body of links that are fixed to one another, with their poses in the frame of the first."""
    parts: list[F32] = []
    mass, moment, about_origin = 0.0, np.zeros(3), np.zeros((3, 3))
    for link, T in rigid:
        parts += transformed_parts(link.parts_m, T)
        if link.inertial is not None:
            centre = T[:3, :3] @ link.inertial.centre_m + T[:3, 3]
            mass += link.inertial.mass_kg
            moment += link.inertial.mass_kg * centre
            upper = np.triu(link.inertial.inertia_kgm2)
            about_origin += T[:3, :3] @ (upper + np.triu(upper, 1).T) @ T[:3, :3].T
            about_origin += link.inertial.mass_kg * _parallel(centre)
    centre = moment / mass if mass > 0 else np.zeros(3)
    values, axes = np.linalg.eigh(about_origin - mass * _parallel(centre))
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    T_body_principal = translation(*centre)
    T_body_principal[:3, :3] = axes
    T_body_joint = np.eye(4)
    name, lower, upper_limit = "", 0.0, 0.0
    if joint is not None:
        T_body_joint[:3, :3] = _x_onto(joint.axis / np.linalg.norm(joint.axis))
        name, lower, upper_limit = joint.name, joint.lower, joint.upper
    kind = "prismatic" if joint is not None and joint.kind == "prismatic" else "revolute"
    return MovingBody(
        parent, name, kind, T_parent_child @ T_body_joint, T_body_joint, lower, upper_limit, tuple(parts),
        0.0 if parts and not mass else max(mass, _LEAST_MASS_KG), T_body_principal,
        np.maximum(values, _LEAST_INERTIA_KGM2),
    )  # fmt: skip


def _parallel(centre_m: F64) -> F64:
    """Inertia (3, 3) about the origin of a unit mass at a point (the parallel axis theorem)."""
    return float(centre_m @ centre_m) * np.eye(3) - np.outer(centre_m, centre_m)


def _x_onto(axis: F64) -> F64:
    """A rotation (3, 3) whose first column is the unit axis."""
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    y = np.asarray(np.cross(axis, other), np.float64)
    y = y / np.linalg.norm(y)
    return np.column_stack([axis, y, np.cross(axis, y)]).astype(np.float64)


# Static parts up to this far beyond the arm's reach take part: knocked over objects can hit them.
_BEYOND_REACH_M = 0.4
_PEDESTAL_SIDES = 16
_PEDESTAL_GAP_M = 0.005  # below the mount, so that the arm's own foot does not touch it
_MOVED_ABOVE_M = 0.0005  # a moved target starts this far above its support


@dataclass(frozen=True, eq=False)
class TrialScene:
    """A scene and a robot, ready for any number of trials. Object 0 is the target."""

    robot: Robot
    articulation: tuple[MovingBody, ...]
    params: TrialParams
    base_radius_m: float
    still_parts_m: tuple[F32, ...]  # each (V, 3), world frame
    still_low_m: F64  # (S, 3) corners of the parts' bounding boxes
    still_high_m: F64
    parts_m: tuple[tuple[F32, ...], ...]  # (K,) of the objects, merged
    mass_kg: F64  # (K,)
    T_world_object: F64  # (K, 4, 4)

    def articulation_at(self, opening_m: float) -> tuple[MovingBody, ...]:
        """The robot's bodies, with fingers that turn as they stand at an opening."""
        return (
            self.articulation
            if self.robot.gripper.linkage is None
            else articulation_of(self.robot, opening_m)
        )


def prepare_trials(
    scene: SettledScene, robot: Robot, params: TrialParams, base_radius_m: float
) -> TrialScene:
    """Geometry of a scene and a robot, ready for any number of trials.

    `base_radius_m` is that of the pedestal, for robots without a base of their own.
    """
    house = scene.house.house
    low, high = (corners_m.astype(np.float64) for corners_m in house.part_boxes_m)
    return TrialScene(
        robot=robot,
        articulation=articulation_of(robot),
        params=params,
        base_radius_m=base_radius_m,
        still_parts_m=tuple(house.parts_m),
        still_low_m=low,
        still_high_m=high,
        parts_m=tuple(merge_parts(model.convex_parts_m, params.hulls_per_object) for model in scene.models),
        mass_kg=np.array([model.mass_kg for model in scene.models]),
        T_world_object=scene.T_world_object,
    )


def still_parts_near(prepared: TrialScene, T_world_base: F64) -> list[F32]:
    """Static parts (V, 3) near the arm: at its sides, above it and below it, since objects fall on floors."""
    reach_m = prepared.robot.reach_m + _BEYOND_REACH_M
    x, y, z = T_world_base[:3, 3]
    apart = np.maximum(0.0, np.maximum(prepared.still_low_m - [x, y, z], [x, y, z] - prepared.still_high_m))
    near = (np.hypot(apart[:, 0], apart[:, 1]) <= reach_m) & (prepared.still_low_m[:, 2] <= z + reach_m)
    return [prepared.still_parts_m[k] for k in np.flatnonzero(near)]


def pedestal_below(prepared: TrialScene, T_world_base: F64) -> F32 | None:
    """Corners (V, 3) of the pedestal below the mount; None for robots with their own base."""
    if prepared.robot.base_radius_m is not None:
        return None
    x, y, z = T_world_base[:3, 3]
    ring = np.array([x, y]) + prepared.base_radius_m * unit_circle(_PEDESTAL_SIDES)
    return prism_corners(ring, 0.0, z - _PEDESTAL_GAP_M).astype(np.float32)


def disturbed(prepared: TrialScene, disturbance: Disturbance) -> TrialScene:
    """The scene with the disturbance applied to its objects."""
    mass_kg, T_world_object = prepared.mass_kg.copy(), prepared.T_world_object.copy()
    mass_kg[0] *= disturbance.mass_scale
    T_world_object[0] = _moved_target(prepared, disturbance.T_target_moved)
    return replace(prepared, mass_kg=mass_kg, T_world_object=T_world_object)


def _moved_target(prepared: TrialScene, T_target_moved: F64) -> F64:
    """The target's true pose (4, 4), raised where its lowest point would be below the planned one."""
    T_planned = prepared.T_world_object[0]
    T = T_planned @ T_target_moved
    if np.array_equal(T_target_moved, np.eye(4)):
        return T
    corners = np.concatenate(prepared.parts_m[0]).astype(np.float64)
    lowest, was = (corners @ M[2, :3] + M[2, 3] for M in (T, T_planned))
    return translation(0.0, 0.0, max(0.0, was.min() - lowest.min()) + _MOVED_ABOVE_M) @ T
