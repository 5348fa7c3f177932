"""Kinematics by pinocchio and contacts by coal: a second opinion on what the package computes itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.kinematics.tree import KinematicTree
from datagen.workers.robots.hulls import polyhedron

# Their binary modules have no types.
pin: Any = pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here")
coal: Any = pytest.importorskip("coal", reason="coal cannot be imported here: run `datagen doctor`")


class TreeOracle:
    """A tree in pinocchio: a model of one joint for each of the tree's."""

    def __init__(self, tree: KinematicTree) -> None:
        self.tree, self.model = tree, pin.Model()
        for j, parent in enumerate(tree.parent.tolist()):
            kind = pin.JointModelPrismaticUnaligned if tree.slides[j] else pin.JointModelRevoluteUnaligned
            self.model.addJoint(parent + 1, kind(tree.axis[j].copy()), se3(tree.T_parent_joint[j]), str(j))
        self.data = self.model.createData()

    def frames(self, q: F64) -> F64:
        """Poses (F, 4, 4) of the frames at the coordinates (A,)."""
        tree = self.tree
        pin.forwardKinematics(self.model, self.data, tree.ratio * q[tree.coordinate] + tree.offset)
        joint = [self.data.oMi[j + 1].homogeneous for j in tree.frame_joint.tolist()]
        return np.matmul(np.stack(joint), tree.T_joint_frame)

    def tcp_jacobian(self, q: F64, step: float = 1e-6) -> F64:
        """Twists (A, 6) of the TCP in its own frame, by differences."""
        rows = []
        for change in np.eye(len(q)) * step:
            low, high = (se3(self.frames(x)[-1]) for x in (q - change, q + change))
            rows.append(pin.log6(low.inverse() * high).vector / (2 * step))
        return np.stack(rows)


def se3(T: F64) -> Any:
    """A pose (3 or 4, 4) as pinocchio has it."""
    return pin.SE3(np.array(T[:3, :3]), np.array(T[:3, 3]))


def off_goal(T: F64, goal: F64) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses."""
    between = se3(T).inverse() * se3(goal)
    return float(np.linalg.norm(between.translation)), float(np.linalg.norm(pin.log3(between.rotation)))


class Hulls:
    """Convex parts (V, 3) in coal; parts of one body share its pose."""

    def __init__(self, parts_m: Sequence[F32 | F64]) -> None:
        self.shapes = [polyhedron(part) for part in parts_m]
        self.center_m = np.array([part.mean(axis=0) for part in parts_m]).reshape(-1, 3)
        reach = [np.linalg.norm(part - part.mean(axis=0), axis=1).max() for part in parts_m]
        self.radius_m = np.array(reach)

    def gaps_m(self, T: F64, other: Hulls, T_other: F64, far_m: float = np.inf) -> F64:
        """Distances (P, Q) to the parts of another body, negative where they overlap.

        Parts whose spheres are at least `far_m` apart get that bound instead.
        """
        here, there = (h.center_m @ P[:3, :3].T + P[:3, 3] for h, P in ((self, T), (other, T_other)))
        out = np.linalg.norm(here[:, None] - there, axis=2) - self.radius_m[:, None] - other.radius_m
        placed, placed_other = (coal.Transform3s(P[:3, :3].copy(), P[:3, 3].copy()) for P in (T, T_other))
        for a, b in np.argwhere(out < far_m).tolist():
            request, result = coal.DistanceRequest(), coal.DistanceResult()
            out[a, b] = coal.distance(self.shapes[a], placed, other.shapes[b], placed_other, request, result)
        return out
