"""The UFACTORY xArm 7 of ManiSkill's `xarm7.urdf`, with the Franka hand on its flange."""

from __future__ import annotations

from math import pi

import numpy as np

from datagen.workers.robots.description import RobotDescription, RobotLimits, turned_homes
from datagen.workers.robots.panda import FRANKA_HAND

XARM7 = RobotDescription(
    name="xarm7",
    urdf="xarm7/xarm7.urdf",
    root_link="link_base",
    arm_joints=tuple(f"joint{k}" for k in range(1, 8)),
    flange_link="link_eef",
    # ManiSkill has no gripper by UFACTORY, only a five-fingered hand.
    T_flange_palm=np.eye(4),
    hand=FRANKA_HAND,
    homes_rad=turned_homes(
        (
            # Folded.
            (-0.77, 0.0, 0.43, 0.0, 2.84, 0.0),
            # Upright, no wider than a pedestal.
            (-0.22, 0.0, 2.41, 0.0, -1.59, 0.0),
        ),
        (0.0, pi / 2, -pi / 2, 2.8, -2.8),
    ),
    # XArm7Ability.arm_stiffness, arm_damping, arm_force_limit in
    # mani_skill/agents/robots/xarm/xarm7_ability.py
    stiffness=1e3,
    damping=1e2,
    force_limit_n=500.0,
    # Largest distance from the shoulder, where joints 1 and 2 meet, to the TCP.
    limits=RobotLimits(reach_m=(0.863, 0.863), base_height_m=None, base_radius_m=None),
)
