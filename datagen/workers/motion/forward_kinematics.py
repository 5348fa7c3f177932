"""Poses of an arm's links for many joint vectors at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.kinematics.tree import KinematicTree, frame_poses
from datagen.workers.motion.collision import Ints
from datagen.workers.robots.robot import Robot

_MOVES = 1e-9
_IDENTITY = np.eye(4)


@dataclass(frozen=True, eq=False)
class ForwardKinematics:
    """A serial arm as a product of exponentials (Brockett 1984): T(q) = E_1(q_1) ... E_A(q_A) T(0).

    F frames: the robot's links, in order, and its TCP as the last one. All joints turn: E(q) is
    I + sin(q) P + (1 - cos(q)) S with constant P and S (Rodrigues).
    """

    first: F64  # (A, 4, 4), P
    second: F64  # (A, 4, 4), S
    T_base_frame: F64  # (F, 4, 4), all joints at zero
    depth: Ints  # (F,), number of joints that move the frame

    def poses(self, q_rad: F64) -> F64:
        """Poses (M, F, 4, 4) in the base frame at the joints (M, A)."""
        out = np.empty((len(q_rad), *self.T_base_frame.shape))
        before = _IDENTITY[None]
        for joint in range(len(self.first) + 1):
            rows = np.flatnonzero(self.depth == joint)
            if len(rows):
                out[:, rows] = np.matmul(before[:, None], self.T_base_frame[rows])
            if joint < len(self.first):
                before = np.matmul(before, self._step(joint, q_rad[:, joint]))
        return out

    def tcp(self, q_rad: F64) -> F64:
        """Poses (M, 4, 4) of the TCP in the base frame at the joints (M, A)."""
        T = _IDENTITY[None]
        for joint in range(len(self.first)):
            T = np.matmul(T, self._step(joint, q_rad[:, joint]))
        return np.matmul(T, self.T_base_frame[-1])

    def _step(self, joint: int, q: F64) -> F64:
        a, b = np.sin(q), 1 - np.cos(q)
        return _IDENTITY + a[:, None, None] * self.first[joint] + b[:, None, None] * self.second[joint]


@dataclass(frozen=True, eq=False)
class TreeKinematics:
    """As `ForwardKinematics` for joints that slide or share coordinates."""

    tree: KinematicTree
    T_base_frame: F64  # (F, 4, 4), all coordinates at zero
    depth: Ints  # (F,), number of joints that move the frame

    def poses(self, q_rad: F64) -> F64:
        """Poses (M, F, 4, 4) in the base frame at the coordinates (M, A)."""
        return frame_poses(self.tree, q_rad)

    def tcp(self, q_rad: F64) -> F64:
        """Poses (M, 4, 4) of the TCP in the base frame at the coordinates (M, A)."""
        return frame_poses(self.tree, q_rad, tcp_only=True)[:, 0]


Kinematics = ForwardKinematics | TreeKinematics


def forward_kinematics(robot: Robot) -> Kinematics:
    """The robot's kinematics; of a plain arm from its poses at zero and with each joint turned by 1 rad."""
    count, tree = len(robot.joint_names), robot.tree
    if robot.slides.any() or count != len(tree.parent):
        zero = frame_poses(tree, np.zeros((1, count)))[0]
        return TreeKinematics(tree, zero, tree.frame_joint + 1)

    def frames(q: F64) -> F64:
        return np.concatenate([robot.T_base_link(q), robot.T_base_tcp(q)[None]])

    zero = frames(np.zeros(count))
    first, second = np.zeros((count, 4, 4)), np.zeros((count, 4, 4))
    moved = np.zeros((count, len(zero)), np.bool_)
    for joint in range(count):
        one = frames(np.eye(count)[joint])
        moved[joint] = np.abs(one - zero).max(axis=(1, 2)) > _MOVES
        moved[joint, -1] = True
        E = one[-1] @ inverse(zero[-1])
        K = (E[:3, :3] - E[:3, :3].T) / (2 * np.sin(1.0))
        # A point r on the axis: t = (I - R) r; the pseudo-inverse leaves out the axis itself.
        r = np.linalg.pinv(np.eye(3) - E[:3, :3], rcond=1e-6) @ E[:3, 3]
        first[joint, :3] = np.column_stack([K, -K @ r])
        second[joint, :3] = np.column_stack([K @ K, -K @ K @ r])
    return ForwardKinematics(first, second, zero, moved.sum(axis=0).astype(np.int64))
