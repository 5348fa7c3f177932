"""Rigid transforms as 4x4 matrices, `T_parent_child`."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64


def translation(x_m: float, y_m: float, z_m: float) -> F64:
    """(4, 4) pure translation."""
    T = np.eye(4)
    T[:3, 3] = (x_m, y_m, z_m)
    return T


def yaw_pose(x_m: float, y_m: float, z_m: float, yaw_rad: float) -> F64:
    """(4, 4) pose rotated about z, counter-clockwise seen from above."""
    T = translation(x_m, y_m, z_m)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T[:2, :2] = ((c, -s), (s, c))
    return T


def inverse(T: F64) -> F64:
    """Inverse of a rigid transform (4, 4), exact where a general inverse is not."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def is_pose(T: F64, rounding: float = 1e-5) -> bool:
    """Whether a matrix (4, 4) is a rigid transform; False for NaN and for reflections.

    `rounding` bounds the entries of R R^T - I: engines and files give rotations as float32.
    """
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, :3]).max() > 2:
        return False
    R = T[:3, :3]
    turns = np.allclose(R @ R.T, np.eye(3), rtol=0, atol=rounding) and float(np.linalg.det(R)) > 0
    return turns and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0))


def quaternion_wxyz(R: F64) -> F64:
    """Unit quaternion (4,), scalar first, of a rotation matrix (3, 3).

    Takes the largest of the four squared components first (Shepperd 1978), so that no branch
    divides by a small number.
    """
    t = np.trace(R)
    squared = np.array([t, R[0, 0], R[1, 1], R[2, 2]]) * 2 - t + 1
    k = int(np.argmax(squared))
    q = np.empty(4)
    if k == 0:
        q[:] = (t + 1, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q[0] = R[m, j] - R[j, m]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[m, m]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + m] = R[m, i] + R[i, m]
    return q / np.linalg.norm(q)


def rotation_of(q_wxyz: F64) -> F64:
    """Rotation matrix (3, 3) of a quaternion (4,), scalar first; it is normalised here."""
    w, x, y, z = np.asarray(q_wxyz, np.float64) / np.linalg.norm(q_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose(position_m: F64, q_wxyz: F64) -> F64:
    """(4, 4) pose of a position (3,) and a quaternion (4,), scalar first."""
    T = np.eye(4)
    T[:3, :3] = rotation_of(q_wxyz)
    T[:3, 3] = position_m
    return T


def look_at(eye_m: F64, target_m: F64) -> F64:
    """(..., 4, 4) camera poses at `eye_m` (..., 3) that look at `target_m`: x right, y down, z forward.

    The image stays upright. If the camera looks straight up or down, the world's x axis points right.
    """
    forward = np.asarray(target_m, np.float64) - eye_m
    forward = forward / np.sqrt(np.vecdot(forward, forward))[..., None]
    level = np.zeros_like(forward[..., 0])
    right = np.stack([forward[..., 1], -forward[..., 0], level], axis=-1)  # forward x z
    length = np.sqrt(np.vecdot(right, right))[..., None]
    right = np.where(length > 1e-9, right / np.maximum(length, 1e-9), [1.0, 0.0, 0.0])
    T = np.zeros((*forward.shape[:-1], 4, 4))
    T[..., :3, 0] = right
    T[..., :3, 1] = np.cross(forward, right)
    T[..., :3, 2] = forward
    T[..., :3, 3] = eye_m
    T[..., 3, 3] = 1.0
    return T
