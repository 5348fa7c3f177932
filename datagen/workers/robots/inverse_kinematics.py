"""Inverse kinematics: damped least squares from one seed, with clamped steps inside the limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio
from scipy.linalg import lapack

from datagen.workers.geometry.mesh import F64

# Binary modules have no types.
pin: Any = pinocchio
_lapack: Any = lapack

POSITION_TOLERANCE_M = 0.0005
ANGLE_TOLERANCE_RAD = float(np.radians(0.5))
_MAX_STEPS = 40
_LONGEST_STEP_RAD = 1.0  # of any joint
_DAMPING = 1e-4
_DAMPING_PER_ERROR = 0.003
# Fails when the best error has not fallen to this share within this number of steps.
_PATIENCE, _PROGRESS = 8, 0.7


def solve(model: Any, data: Any, frame: int, T_base_tcp: F64, q_seed_rad: F64) -> F64 | None:
    """Joints (A,) within the model's limits that put the frame at the pose (4, 4), or None.

    Levenberg-Marquardt with damping that grows with the squared error (Sugihara 2011), on the pose error
    as a twist in the frame itself; a joint at its limit stays there while the step pushes it out.
    """
    low, high = model.lowerPositionLimit, model.upperPositionLimit
    goal = pin.SE3(T_base_tcp)
    q = np.minimum(np.maximum(q_seed_rad, low), high)
    best, best_at = np.inf, 0
    for step in range(_MAX_STEPS):
        pin.computeJointJacobians(model, data, q)
        here = pin.updateFramePlacement(model, data, frame)
        error = pin.log6(here.actInv(goal)).vector
        # Plain floats and ndarray.dot: half of the time would go into the wrappers around them.
        x, y, z, a, b, c = error.tolist()
        distance, angle = x * x + y * y + z * z, a * a + b * b + c * c
        if distance < POSITION_TOLERANCE_M**2 and angle < ANGLE_TOLERANCE_RAD**2:
            return q
        squared = distance + angle
        if squared < _PROGRESS**2 * best:
            best, best_at = squared, step
        elif step - best_at >= _PATIENCE:
            return None
        J = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL)
        H = J.dot(J.T)
        H.flat[::7] += _DAMPING + _DAMPING_PER_ERROR * squared
        dq = J.T.dot(_lapack.dposv(H, error)[1])
        longest = max(map(abs, dq.tolist()))
        if longest > _LONGEST_STEP_RAD:
            dq *= _LONGEST_STEP_RAD / longest
        q = np.minimum(np.maximum(q + dq, low), high)
    return None
