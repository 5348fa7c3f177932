"""Straight-line motions of the hand: joints along a row of poses, smooth, near the line and free."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.arm_collision import Surroundings
from datagen.workers.motion.rrt_connect import dense

_OFF_LINE_M = 0.002  # between neighbouring points, where joints are interpolated


def follow_line(
    at: Surroundings, T_base_tcp: F64, q_first: F64, q_last: F64 | None, is_target_held: bool
) -> F64 | None:
    """Joints (K, A) at the hand's poses (K, 4, 4), which lie on a straight line and begin at `q_first`.

    `q_last`, where the end is known, is its joint vector. None where a pose has no solution, a joint
    jumps, the hand leaves the line by more than 2 mm in between, or the arm collides.
    """
    scene = at.scene
    q = [q_first]
    last = len(T_base_tcp) - 1
    for k in range(1, last + 1):
        if k == last and q_last is not None:
            found = q_last
        else:
            # The seed: a step towards the known end, or the last step again.
            step = (q_last - q[-1]) / (last - k + 1) if q_last is not None else q[-1] - q[max(k - 2, 0)]
            found = scene.robot.ik(T_base_tcp[k], q[-1] + step)
        if found is None or np.abs(found - q[-1]).max() > scene.params.max_joint_jump_rad:
            return None
        q.append(found)
    rows = np.array(q)
    between = scene.moving.kinematics.tcp((rows[1:] + rows[:-1]) / 2)[:, :3, 3]
    middle = (T_base_tcp[1:, :3, 3] + T_base_tcp[:-1, :3, 3]) / 2
    if last and np.linalg.norm(between - middle, axis=1).max() > _OFF_LINE_M:
        return None
    path = dense(rows, scene.params.check_step_rad)
    return rows if at.first_arm_blocked(path, is_target_held) == len(path) else None
