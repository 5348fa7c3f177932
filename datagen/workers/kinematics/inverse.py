"""Forward and inverse kinematics of any tree of joints, compiled. Poses are (3, 4): rotation and position.

The joints' axes are z: `KinematicTree.along_z` turns their frames so.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled, in_memory, struct
from datagen.workers.kinematics.tree import KinematicTree

POSITION_TOLERANCE_M = 0.0005
ANGLE_TOLERANCE_RAD = math.radians(0.5)
_MAX_STEPS = 40
_LONGEST_STEP = 1.0  # of any coordinate
_DAMPING = 1e-4
_DAMPING_PER_ERROR = 0.003
# Fails when the best error has not fallen to this share within this number of steps.
_PATIENCE, _PROGRESS = 8, 0.7
_SMALL = 1e-10


class IkWork(NamedTuple):
    """Arrays that `solve` writes into."""

    joints: F64  # (J, 3, 4)
    tcp: F64  # (3, 4)
    jacobian: F64  # (A, 6)
    error: F64  # (6,)
    step: F64  # (A,)
    scratch: F64  # (5, 3)


new_ik_work = struct(IkWork)
struct(KinematicTree)


@compiled
def put(A: F64, out: F64) -> None:
    """out = A for matrices; assigning them would compile NumPy's messages too."""
    for i in range(len(A)):
        for k in range(A.shape[1]):
            out[i, k] = A[i, k]


@compiled
def put_row(a: F64, out: F64) -> None:
    """out = a for vectors."""
    for i in range(len(a)):
        out[i] = a[i]


@compiled
def one_turn(lower: float, upper: float) -> tuple[float, float]:
    """The part of a coordinate's range with every position once: at most a turn, from -pi if possible."""
    low = min(max(-math.pi, lower), max(lower, upper - 2 * math.pi))
    return low, min(upper, low + 2 * math.pi)


@compiled
def compose(A: F64, B: F64, out: F64) -> None:
    """out = A B for poses (3, 4)."""
    b00, b01, b02, b03 = B[0, 0], B[0, 1], B[0, 2], B[0, 3]
    b10, b11, b12, b13 = B[1, 0], B[1, 1], B[1, 2], B[1, 3]
    b20, b21, b22, b23 = B[2, 0], B[2, 1], B[2, 2], B[2, 3]
    for i in range(3):
        x, y, z, t = A[i, 0], A[i, 1], A[i, 2], A[i, 3]
        out[i, 0] = x * b00 + y * b10 + z * b20
        out[i, 1] = x * b01 + y * b11 + z * b21
        out[i, 2] = x * b02 + y * b12 + z * b22
        out[i, 3] = x * b03 + y * b13 + z * b23 + t


@compiled
def joint_poses(tree: KinematicTree, T_root: F64, q: F64, out: F64) -> None:
    """Poses (J, 3, 4) of the joints, moved by the coordinates (A,); `T_root` (3, 4) is that of the base."""
    for j in range(len(tree.parent)):
        p, T = tree.parent[j], out[j]
        compose(T_root if p < 0 else out[p], tree.T_parent_joint[j], T)
        x = tree.ratio[j] * q[tree.coordinate[j]] + tree.offset[j]
        if tree.slides[j]:
            for i in range(3):
                T[i, 3] += x * T[i, 2]
            continue
        s, c = math.sin(x), math.cos(x)
        for i in range(3):
            a, b = T[i, 0], T[i, 1]
            T[i, 0], T[i, 1] = c * a + s * b, c * b - s * a


@compiled
def frame_poses(tree: KinematicTree, T_root: F64, joints: F64, out: F64) -> None:
    """Poses (F, 3, 4) of the frames, from those of the joints (J, 3, 4)."""
    for f in range(len(tree.frame_joint)):
        j = tree.frame_joint[f]
        compose(T_root if j < 0 else joints[j], tree.T_joint_frame[f], out[f])


@compiled
def tcp_pose(tree: KinematicTree, T_root: F64, joints: F64, out: F64) -> None:
    """Pose (3, 4) of the last frame, the TCP."""
    j = tree.frame_joint[-1]
    compose(T_root if j < 0 else joints[j], tree.T_joint_frame[-1], out)


@compiled
def pose_error(T: F64, goal: F64, out: F64, scratch: F64) -> None:
    """Twist (6,) in the frame T that leads to the goal: position, then rotation (logarithm of SE(3)).

    `scratch` is (5, 3).
    """
    R, p = scratch[:3], scratch[3]  # new arrays would cost as much as the numbers in them
    for i in range(3):
        p[i] = 0.0
        for k in range(3):
            p[i] += T[k, i] * (goal[k, 3] - T[k, 3])
            R[i, k] = T[0, i] * goal[0, k] + T[1, i] * goal[1, k] + T[2, i] * goal[2, k]
    wx, wy, wz = (R[2, 1] - R[1, 2]) / 2, (R[0, 2] - R[2, 0]) / 2, (R[1, 0] - R[0, 1]) / 2
    s, c = math.sqrt(wx * wx + wy * wy + wz * wz), (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2
    angle = math.atan2(s, c)
    if s > 1e-7:
        wx, wy, wz = wx * angle / s, wy * angle / s, wz * angle / s
    elif c < 0:  # half a turn: the axis by the largest column of R + I
        k = 0
        for i in range(1, 3):
            if R[i, i] > R[k, k]:
                k = i
        n = math.sqrt((R[k, k] + 1) / 2)
        w = scratch[4]
        for i in range(3):
            w[i] = angle * (n if i == k else (R[i, k] + R[k, i]) / (4 * n))
        wx, wy, wz = w[0], w[1], w[2]
    # V^-1 p = p - w x p / 2 + b w x (w x p)
    b = 1 / 12.0
    if angle > 1e-4:
        b = (1 - angle * math.sin(angle) / (2 * (1 - math.cos(angle)))) / (angle * angle)
    x, y, z = wy * p[2] - wz * p[1], wz * p[0] - wx * p[2], wx * p[1] - wy * p[0]
    out[0] = p[0] - x / 2 + b * (wy * z - wz * y)
    out[1] = p[1] - y / 2 + b * (wz * x - wx * z)
    out[2] = p[2] - z / 2 + b * (wx * y - wy * x)
    out[3], out[4], out[5] = wx, wy, wz


@compiled
def tcp_jacobian(tree: KinematicTree, joints: F64, T: F64, out: F64) -> None:
    """Jacobian (A, 6), one row a coordinate: twist of the TCP at T in its own frame."""
    for k in range(len(out)):
        for i in range(6):
            out[k, i] = 0.0
    j = tree.frame_joint[-1]
    while j >= 0:
        P = joints[j]
        ax, ay, az = P[0, 2], P[1, 2], P[2, 2]
        k, ratio = tree.coordinate[j], tree.ratio[j]
        vx, vy, vz = ax, ay, az
        if not tree.slides[j]:
            dx, dy, dz = T[0, 3] - P[0, 3], T[1, 3] - P[1, 3], T[2, 3] - P[2, 3]
            vx, vy, vz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
            for i in range(3):
                out[k, 3 + i] += ratio * (T[0, i] * ax + T[1, i] * ay + T[2, i] * az)
        for i in range(3):
            out[k, i] += ratio * (T[0, i] * vx + T[1, i] * vy + T[2, i] * vz)
        j = tree.parent[j]


@compiled
def _damped_step(J: F64, e: F64, damping: float, step: F64) -> None:
    """The change (A,) of the coordinates that leads along the twist e (6,): J (J^T J + damping I)^-1 e.

    By Cholesky's decomposition of the matrix (6, 6), whose numbers are variables: they stay in registers.
    """
    h00 = h10 = h11 = h20 = h21 = h22 = h30 = h31 = h32 = h33 = h40 = 0.0
    h41 = h42 = h43 = h44 = h50 = h51 = h52 = h53 = h54 = h55 = 0.0
    for m in range(len(J)):
        a, b, c, d, f, g = J[m, 0], J[m, 1], J[m, 2], J[m, 3], J[m, 4], J[m, 5]
        h00, h10, h11 = h00 + a * a, h10 + b * a, h11 + b * b
        h20, h21, h22 = h20 + c * a, h21 + c * b, h22 + c * c
        h30, h31, h32, h33 = h30 + d * a, h31 + d * b, h32 + d * c, h33 + d * d
        h40, h41, h42, h43, h44 = h40 + f * a, h41 + f * b, h42 + f * c, h43 + f * d, h44 + f * f
        h50, h51, h52, h53 = h50 + g * a, h51 + g * b, h52 + g * c, h53 + g * d
        h54, h55 = h54 + g * f, h55 + g * g
    l00 = math.sqrt(h00 + damping)
    l10, l20, l30, l40, l50 = h10 / l00, h20 / l00, h30 / l00, h40 / l00, h50 / l00
    l11 = math.sqrt(h11 + damping - l10 * l10)
    l21, l31, l41, l51 = (
        (h21 - l20 * l10) / l11,
        (h31 - l30 * l10) / l11,
        (h41 - l40 * l10) / l11,
        (h51 - l50 * l10) / l11,
    )
    l22 = math.sqrt(h22 + damping - l20 * l20 - l21 * l21)
    l32 = (h32 - l30 * l20 - l31 * l21) / l22
    l42 = (h42 - l40 * l20 - l41 * l21) / l22
    l52 = (h52 - l50 * l20 - l51 * l21) / l22
    l33 = math.sqrt(h33 + damping - l30 * l30 - l31 * l31 - l32 * l32)
    l43 = (h43 - l40 * l30 - l41 * l31 - l42 * l32) / l33
    l53 = (h53 - l50 * l30 - l51 * l31 - l52 * l32) / l33
    l44 = math.sqrt(h44 + damping - l40 * l40 - l41 * l41 - l42 * l42 - l43 * l43)
    l54 = (h54 - l50 * l40 - l51 * l41 - l52 * l42 - l53 * l43) / l44
    l55 = math.sqrt(h55 + damping - l50 * l50 - l51 * l51 - l52 * l52 - l53 * l53 - l54 * l54)
    y0 = e[0] / l00
    y1 = (e[1] - l10 * y0) / l11
    y2 = (e[2] - l20 * y0 - l21 * y1) / l22
    y3 = (e[3] - l30 * y0 - l31 * y1 - l32 * y2) / l33
    y4 = (e[4] - l40 * y0 - l41 * y1 - l42 * y2 - l43 * y3) / l44
    y5 = (e[5] - l50 * y0 - l51 * y1 - l52 * y2 - l53 * y3 - l54 * y4) / l55
    y5 = y5 / l55
    y4 = (y4 - l54 * y5) / l44
    y3 = (y3 - l43 * y4 - l53 * y5) / l33
    y2 = (y2 - l32 * y3 - l42 * y4 - l52 * y5) / l22
    y1 = (y1 - l21 * y2 - l31 * y3 - l41 * y4 - l51 * y5) / l11
    y0 = (y0 - l10 * y1 - l20 * y2 - l30 * y3 - l40 * y4 - l50 * y5) / l00
    for m in range(len(J)):
        K = J[m]
        step[m] = K[0] * y0 + K[1] * y1 + K[2] * y2 + K[3] * y3 + K[4] * y4 + K[5] * y5


@compiled
def solve(tree: KinematicTree, T_root: F64, goal: F64, q: F64, work: IkWork) -> bool:
    """Move the coordinates (A,), in place, until the TCP is at the goal (3, 4); whether it is.

    Levenberg-Marquardt with damping that grows with the squared error (Sugihara 2011), on the pose error as
    a twist in the TCP's frame. Where it pushes coordinates at their limits out, the step is computed again
    without them: the others take over. The goal is reached within 0.5 mm and 0.5 degrees.
    """
    joints, T, J = work.joints, work.tcp, work.jacobian
    count, e, dq = len(q), work.error, work.step
    for k in range(count):
        q[k] = min(max(q[k], tree.lower[k]), tree.upper[k])
    best, best_at = np.inf, 0
    for step in range(_MAX_STEPS):
        joint_poses(tree, T_root, q, joints)
        tcp_pose(tree, T_root, joints, T)
        pose_error(T, goal, e, work.scratch)
        distance = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
        angle = e[3] * e[3] + e[4] * e[4] + e[5] * e[5]
        if distance < POSITION_TOLERANCE_M**2 and angle < ANGLE_TOLERANCE_RAD**2:
            return True
        squared = distance + angle
        if squared < _PROGRESS**2 * best:
            best, best_at = squared, step
        elif step - best_at >= _PATIENCE:
            return False
        tcp_jacobian(tree, joints, T, J)
        damping, is_stuck = _DAMPING + _DAMPING_PER_ERROR * squared, True
        while is_stuck:
            _damped_step(J, e, damping, dq)
            is_stuck = False
            for m in range(count):
                if (q[m] <= tree.lower[m] and dq[m] < 0) or (q[m] >= tree.upper[m] and dq[m] > 0):
                    is_stuck = True
                    for i in range(6):
                        J[m, i] = 0.0
        longest = 0.0
        for m in range(count):
            longest = max(longest, abs(dq[m]))
        scale = min(1.0, _LONGEST_STEP / longest) if longest > 0 else 1.0
        for m in range(count):
            q[m] = min(max(q[m] + scale * dq[m], tree.lower[m]), tree.upper[m])
    return False


@compiled
def ik_workspace(tree: KinematicTree) -> IkWork:
    """Arrays for `solve`."""
    return new_ik_work(
        np.empty((len(tree.parent), 3, 4)),
        np.empty((3, 4)),
        np.empty((len(tree.lower), 6)),
        np.empty(6),
        np.empty(len(tree.lower)),
        np.empty((5, 3)),
    )


@compiled
def _poses_at(tree: KinematicTree, q: F64, joints: F64, root: F64, out: F64) -> None:
    joint_poses(tree, root, q, joints)
    frame_poses(tree, root, joints, out)


class TreePoses:
    """Forward and inverse kinematics of one tree, called from Python; base frame. Not safe for threads."""

    def __init__(self, tree: KinematicTree) -> None:
        self._tree = in_memory(tree.along_z())
        self._joints, self._root = np.empty((len(tree.parent), 3, 4)), np.eye(4)[:3].copy()
        self._frames, self._work = len(tree.frame_joint), ik_workspace(self._tree)

    def __call__(self, q: F64) -> F64:
        """Poses (F, 3, 4) of the frames at coordinates (A,)."""
        out = np.empty((self._frames, 3, 4))
        _poses_at(self._tree, q, self._joints, self._root, out)
        return out

    def solve(self, T_tcp: F64, q_seed: F64) -> F64 | None:
        """Coordinates (A,) within their limits that put the TCP at the pose (4, 4), or None: see `solve`."""
        q = np.array(q_seed, np.float64)
        goal = np.ascontiguousarray(T_tcp[:3])
        return q if solve(self._tree, self._root, goal, q, self._work) else None
