"""A robot's moving bodies, read once from its URDF, from which a physics engine builds the arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.robots.robot import Robot
from datagen.workers.robots.urdf import Joint, UrdfTree, read_urdf

# Bodies without mass still need a little, at the joint.
_LEAST_MASS_KG, _LEAST_INERTIA_KGM2 = 1e-3, 1e-6


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
    mass_kg: float
    T_body_principal: F64  # (4, 4), centre of mass and principal axes
    inertia_kgm2: F64  # (3,), along them


@dataclass(frozen=True, eq=False)
class Articulation:
    """The bodies of a robot, parents first; arm joints come before those of the fingers in `order`."""

    bodies: tuple[MovingBody, ...]
    order: tuple[int, ...]  # bodies moved by the arm's joints, then by the two fingers'
    T_base_root: F64  # (4, 4), body 0 in the base frame


def articulation_of(robot: Robot) -> Articulation:
    """Read the URDF, in which only the joints of the arm and the fingers move.

    Raises InputError where it is broken or lacks a joint.
    """
    tree = read_urdf(robot.urdf)
    moving = (*robot.joint_names, *robot.finger_joint_names)
    for name in moving:
        tree.joint(name)
    root = next(name for name in tree.links if tree.joint_above(name) is None)
    bodies: list[MovingBody] = []
    waiting: list[tuple[int, Joint | None, F64, str]] = [(-1, None, np.eye(4), root)]
    while waiting:
        parent, joint, T_parent_child, link = waiting.pop(0)
        rigid = _rigid_links(tree, link, moving)
        index = len(bodies)
        bodies.append(_body(tree, rigid, parent, joint, T_parent_child, robot))
        for name, T_body_link in rigid:
            for below in tree.children(name):
                if below.name in moving:
                    waiting.append((index, below, T_body_link @ below.T_parent_child, below.child))
    by_joint = {body.joint: k for k, body in enumerate(bodies)}
    return Articulation(tuple(bodies), tuple(by_joint[name] for name in moving), robot.T_base_root)


def _rigid_links(tree: UrdfTree, link: str, moving: tuple[str, ...]) -> list[tuple[str, F64]]:
    """The link and all links fixed to it by joints that do not move, with their poses in its frame."""
    found = [(link, np.eye(4))]
    for name, T in found:
        for joint in tree.children(name):
            if joint.name not in moving:
                found.append((joint.child, T @ joint.T_parent_child))
    return found


def _body(
    tree: UrdfTree,
    rigid: list[tuple[str, F64]],
    parent: int,
    joint: Joint | None,
    T_parent_child: F64,
    robot: Robot,
) -> MovingBody:
    shapes = dict(zip(robot.link_names, robot.link_parts_m, strict=True))
    parts: list[F32] = []
    mass, moment, about_origin = 0.0, np.zeros(3), np.zeros((3, 3))
    for name, T in rigid:
        link = tree.link(name)
        for part in shapes.get(name, ()):
            parts.append((part @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
        if link.inertial is not None:
            centre = T[:3, :3] @ link.inertial.centre_m + T[:3, 3]
            mass += link.inertial.mass_kg
            moment += link.inertial.mass_kg * centre
            about_origin += T[:3, :3] @ link.inertial.inertia_kgm2 @ T[:3, :3].T
            about_origin += link.inertial.mass_kg * _parallel(centre)
    centre = moment / mass if mass > 0 else np.zeros(3)
    values, axes = np.linalg.eigh(about_origin - mass * _parallel(centre))
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    T_body_principal = translation(*centre)
    T_body_principal[:3, :3] = axes
    T_body_joint = np.eye(4)
    kind: Literal["revolute", "prismatic"] = "revolute"
    name, lower, upper = "", 0.0, 0.0
    if joint is not None:
        T_body_joint[:3, :3] = _x_onto(joint.axis)
        kind = "prismatic" if joint.kind == "prismatic" else "revolute"
        name, lower, upper = joint.name, joint.lower, joint.upper
        if name in robot.joint_names:
            k = robot.joint_names.index(name)
            lower, upper = float(robot.q_lower_rad[k]), float(robot.q_upper_rad[k])
    return MovingBody(
        parent, name, kind, T_parent_child @ T_body_joint, T_body_joint, lower, upper, tuple(parts),
        max(mass, _LEAST_MASS_KG), T_body_principal, np.maximum(values, _LEAST_INERTIA_KGM2),
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
