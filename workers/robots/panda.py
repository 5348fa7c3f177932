"""The Franka Emika Panda of ManiSkill's `panda_v2.urdf`, in its own size and as a family of scaled arms."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.robots.description import RobotDescription, RobotLimits, WristExtension, turned_homes
from datagen.workers.robots.franka_hand import FRANKA_HAND

PANDA = RobotDescription(
    name="panda",
    urdf="panda/panda_v2.urdf",
    root_link="panda_link0",
    arm_joints=tuple(f"panda_joint{k}" for k in range(1, 8)),
    flange_link="panda_link8",
    T_flange_palm=yaw_pose(0.0, 0.0, 0.0, -pi / 4),  # panda_hand_joint
    hand=FRANKA_HAND,
    homes_rad=turned_homes(
        (
            # Folded, the elbow to the back.
            (-1.6, 0.0, -2.5, 0.0, 1.7, pi / 4),
            # Upright, no wider than a pedestal.
            (-0.11, 0.0, -0.22, 0.0, 3.04, pi / 4),
        ),
        (0.0, pi / 2, -pi / 2, 2.8, -2.8),
    ),
    # Panda.arm_stiffness, arm_damping, arm_force_limit in mani_skill/agents/robots/panda/panda.py
    stiffness=1e3,
    damping=1e2,
    force_limit_n=100.0,
    # Largest distance from the shoulder, where joints 1 and 2 meet, to the TCP.
    limits=RobotLimits(reach_m=(0.947, 0.947), base_height_m=None, base_radius_m=None),
)

PANDA_SCALED = replace(
    PANDA,
    name="panda-scaled",
    # The span of d_arm in the paper's Sec. IV-A.
    limits=RobotLimits(reach_m=(0.3, 1.0), base_height_m=None, base_radius_m=None),
    # Below half a metre the links shrink so far that the hand, which keeps its size, meets the forearm.
    extension=WristExtension(longest_m=0.05, radius_m=0.02, none_from_reach_m=0.5),
)
