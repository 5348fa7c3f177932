"""Joints and frames of a robot as plain arrays: all that forward kinematics of any tree needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


class KinematicTree(NamedTuple):
    """J joints, each after the one that carries it, moved by A coordinates, and F frames on them.

    Joint j stands at `ratio[j] * q[coordinate[j]] + offset[j]`: radians where it turns, metres where it
    slides. Joints that share a coordinate move together, such as mimic joints and the segments of a
    telescope. The last frame is the TCP.
    """

    parent: Ints  # (J,), the joint that carries each; -1 is the base
    T_parent_joint: F64  # (J, 4, 4), at position 0
    axis: F64  # (J, 3), unit, joint frame
    slides: Bools  # (J,)
    coordinate: Ints  # (J,)
    ratio: F64  # (J,)
    offset: F64  # (J,)
    lower: F64  # (A,), limits of the coordinates
    upper: F64  # (A,)
    frame_joint: Ints  # (F,), the joint that carries each frame; -1 is the base
    T_joint_frame: F64  # (F, 4, 4)

    def along_z(self) -> KinematicTree:
        """The same tree with joint frames turned so that every axis is z."""
        turn = np.stack([_z_to(axis) for axis in self.axis])
        T_parent_joint = np.matmul(self.T_parent_joint, turn)
        for j, parent in enumerate(self.parent.tolist()):
            if parent >= 0:
                T_parent_joint[j] = turn[parent].T @ T_parent_joint[j]
        T_frame = self.T_joint_frame.copy()
        carried = self.frame_joint >= 0
        T_frame[carried] = np.matmul(turn[self.frame_joint[carried]].transpose(0, 2, 1), T_frame[carried])
        axis = np.tile([0.0, 0.0, 1.0], (len(self.axis), 1))
        return self._replace(T_parent_joint=T_parent_joint, axis=axis, T_joint_frame=T_frame)

    def hand_joints(self) -> list[int]:
        """The joints that move the last frame, the hand's, from the nearest to the base."""
        joints, j = list[int](), int(self.frame_joint[-1])
        while j >= 0:
            joints.append(j)
            j = int(self.parent[j])
        return joints


def _z_to(axis: F64) -> F64:
    """A rotation (4, 4) that takes z to the unit axis (3,); the identity for z itself."""
    x, y, z = axis
    if z < -0.999999:
        return np.diag([1.0, -1.0, -1.0, 1.0])
    v = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    T = np.eye(4)
    T[:3, :3] += v + v @ v / (1 + z)
    return T


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Positions of a model's joints (J,) from the coordinates (A,): matrix @ q + offset."""

    matrix: F64  # (J, A)
    offset: F64  # (J,)
    are_joints: bool  # each joint has a coordinate of its own, in order

    @staticmethod
    def of(tree: KinematicTree) -> Coordinates:
        """Those of a tree."""
        matrix = np.zeros((len(tree.ratio), len(tree.lower)))
        matrix[np.arange(len(tree.ratio)), tree.coordinate] = tree.ratio
        plain = matrix.shape[0] == matrix.shape[1] and bool((matrix == np.eye(len(matrix))).all())
        return Coordinates(matrix, tree.offset, plain and not tree.offset.any())

    def __call__(self, q: F64) -> F64:
        return q if self.are_joints else self.matrix @ q + self.offset

    def of_joints(self, positions: F64) -> F64:
        """Coordinates (A,) of positions (J,), means where joints share one."""
        if self.are_joints:
            return positions
        weights = np.abs(self.matrix)
        shares = np.divide(positions - self.offset, self.matrix.sum(axis=1))
        return shares @ weights / weights.sum(axis=0)


def frame_poses(tree: KinematicTree, q: F64, tcp_only: bool = False) -> F64:
    """Poses (M, F, 4, 4) of the frames, or (M, 1, 4, 4) of the TCP, at coordinates (M, A); base frame."""
    base, joints = np.eye(4)[None], list[F64]()
    position = tree.ratio * q[:, tree.coordinate] + tree.offset  # (M, J)
    for j, parent in enumerate(tree.parent.tolist()):
        before = np.matmul(joints[parent] if parent >= 0 else base, tree.T_parent_joint[j])
        joints.append(np.matmul(before, joint_motion(tree.axis[j], bool(tree.slides[j]), position[:, j])))
    rows = range(len(tree.frame_joint))[-1:] if tcp_only else range(len(tree.frame_joint))
    out = np.empty((len(q), len(rows), 4, 4))
    for k, f in enumerate(rows):
        j = int(tree.frame_joint[f])
        out[:, k] = np.matmul(joints[j] if j >= 0 else base, tree.T_joint_frame[f])
    return out


def joint_motion(axis: F64, slides: bool, position: F64) -> F64:
    """Motions (M, 4, 4) of a joint by positions (M,), radians or metres, along or about its axis (3,)."""
    T = np.tile(np.eye(4), (len(position), 1, 1))
    if slides:
        T[:, :3, 3] = position[:, None] * axis
        return T
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s, c = np.sin(position)[:, None, None], np.cos(position)[:, None, None]
    T[:, :3, :3] += s * K + (1 - c) * (K @ K)
    return T
