"""A robot that is opened: pinocchio moves it, coal looks for links that touch."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio

from datagen.workers.geometry.mesh import F64, Mesh
from datagen.workers.geometry.transforms import inverse
from datagen.workers.robots.assembly import Assembly, assemble, gripper_of
from datagen.workers.robots.description import RobotDescription
from datagen.workers.robots.inverse_kinematics import solve
from datagen.workers.robots.robot import Gripper, Parts
from datagen.workers.robots.robot_files import RobotFiles, hull_of
from datagen.workers.robots.self_collision import SelfCollision
from datagen.workers.robots.visual_meshes import body_mesh

# Its binary modules have no types.
pin: Any = pinocchio


class Arm:
    """Implements `datagen.workers.robots.robot.Robot`; see there for what each part means."""

    def __init__(self, description: RobotDescription, reach_m: float | None, base_height_m: float) -> None:
        lift = description.lift
        lift_m = base_height_m - lift.mount_at_zero_m if lift else 0.0
        assembly = assemble(description, reach_m, lift_m)
        count = len(assembly.arm)
        self.name = description.name
        self.reach_m: float = assembly.reach_m if reach_m is None else reach_m
        self.scale = assembly.scale
        self.base_height_m = base_height_m
        self.base_radius_m = description.limits.base_radius_m
        self.gripper: Gripper = gripper_of(description.hand.name, description.hand.pad_size_m, assembly)
        self.T_base_root: F64 = inverse(assembly.T_root_mount)
        self.shoulder_m: F64 = (self.T_base_root @ assembly.arm[0].T_parent_child)[:3, 3]
        self.joint_names = tuple(joint.name for joint in assembly.arm)
        self.finger_joint_names = (assembly.fingers[0].name, assembly.fingers[1].name)
        self.q_lower_rad: F64 = np.array([joint.lower for joint in assembly.arm])
        self.q_upper_rad: F64 = np.array([joint.upper for joint in assembly.arm])
        self.speed_limit_radps: F64 = np.array([joint.speed for joint in assembly.arm])
        self.homes_rad: F64 = np.array(description.homes_rad)
        self.stiffness = description.stiffness
        self.damping = description.damping
        self.force_limit_n = description.force_limit_n
        self.link_names = tuple(body.name for body in assembly.bodies)
        self.link_parts_m: tuple[Parts, ...] = tuple(body.parts_m for body in assembly.bodies)
        self._assembly = assembly
        self._model = _model_of(assembly, self.T_base_root)
        self._data = self._model.createData()
        self._tcp = self._model.getFrameId("tcp")
        first = self._tcp - len(self.link_names)
        self._frames = range(first, self._tcp)
        frames = self._model.frames
        joints = [frames[f].parentJoint for f in self._frames]
        placements = [frames[f].placement.homogeneous for f in self._frames]
        # One hull a finger is close enough and four times as fast as its boxes.
        parts = [*self.link_parts_m[:-2], *((hull_of(p),) for p in self.link_parts_m[-2:])]
        self._self_collision = SelfCollision(self._model, parts, joints, placements)
        self.self_pairs = self._self_collision.pairs
        names = self.link_names
        disabled = [
            (names[a], names[b])
            for a in range(len(names))
            for b in range(a + 1, len(names))
            if (a, b) not in self.self_pairs and not (b <= count and b == a + 1)
        ]
        self._files = RobotFiles(self.name, assembly, disabled)

    @property
    def urdf(self) -> Path:
        """Path of its URDF, written now where it is not there."""
        return self._files.urdf()

    def at_height(self, base_height_m: float) -> Arm:
        """The same arm on a pedestal of another height; both share what they are made of."""
        other = copy.copy(self)
        other.base_height_m = base_height_m
        return other

    def T_base_link(self, q_rad: F64) -> F64:
        """Poses (L, 4, 4) of the links at the joints (A,)."""
        pin.framesForwardKinematics(self._model, self._data, q_rad)
        placements = self._data.oMf
        T = np.empty((len(self._frames), 4, 4))
        for k, frame in enumerate(self._frames):
            T[k] = placements[frame].homogeneous
        return T

    def T_base_tcp(self, q_rad: F64) -> F64:
        """Pose (4, 4) of the gripper's TCP at the joints (A,)."""
        pin.forwardKinematics(self._model, self._data, q_rad)
        return pin.updateFramePlacement(self._model, self._data, self._tcp).homogeneous

    def ik(self, T_base_tcp: F64, q_seed_rad: F64) -> F64 | None:
        """Joints (A,) within the limits that put the TCP at the pose, or None."""
        return solve(self._model, self._data, self._tcp, T_base_tcp, q_seed_rad)

    def collides_itself(self, q_rad: F64) -> bool:
        """Whether any of `self_pairs` touch at the joints (A,)."""
        return self._self_collision.touches(q_rad)

    def link_meshes(self) -> tuple[Mesh, ...]:
        """(L,) meshes to look at, link frames."""
        return tuple(body_mesh(body) for body in self._assembly.bodies)


def _model_of(assembly: Assembly, T_base_root: F64) -> Any:
    """Joints of the arm alone; then a frame for every body, fingers open, and one for the TCP."""
    model = pin.Model()
    at = 0
    placements = [T_base_root]
    parents = [0]
    for joint in assembly.arm:
        T = (T_base_root if at == 0 else np.eye(4)) @ joint.T_parent_child
        kind = (
            pin.JointModelRZ()
            if np.array_equal(joint.axis, (0, 0, 1))
            else pin.JointModelRevoluteUnaligned(joint.axis)
        )
        limits = (np.array([v]) for v in (joint.effort, joint.speed, joint.lower, joint.upper))
        at = model.addJoint(at, kind, pin.SE3(T), joint.name, *limits)
        placements.append(np.eye(4))
        parents.append(at)
    T_palm = assembly.palm.T_parent_child
    placements.append(T_palm)
    for joint in assembly.fingers:
        slide = np.eye(4)
        slide[:3, 3] = joint.axis * joint.upper
        placements.append(T_palm @ joint.T_parent_child @ slide)
    placements.append(T_palm @ assembly.T_palm_tcp)
    parents += [at] * 4
    names = [*(body.name for body in assembly.bodies), "tcp"]
    for name, joint_id, T in zip(names, parents, placements, strict=True):
        model.addFrame(pin.Frame(name, joint_id, 0, pin.SE3(T), pin.FrameType.OP_FRAME))
    return model
