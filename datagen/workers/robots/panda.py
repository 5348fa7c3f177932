"""The Franka Emika Panda of ManiSkill's `panda_v2.urdf`, its hand, and a family of scaled arms."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from datagen.workers.geometry.transforms import translation, yaw_pose
from datagen.workers.robots.description import (
    HandDescription,
    RobotDescription,
    RobotLimits,
    WristExtension,
    turned_homes,
)

# Two fingers that open to 8 cm.
FRANKA_HAND = HandDescription(
    name="franka-hand",
    urdf="panda/panda_v2.urdf",
    palm_link="panda_hand",
    finger_joints=("panda_finger_joint1", "panda_finger_joint2"),
    # panda_hand_tcp_joint: the middle of the pads, 0.25 mm short of the centre of the boxes that touch.
    T_palm_tcp=translation(0.0, 0.0, 0.1034),
    # "rubber tip with which to grasp" of both fingers: 17.5 mm wide, 18.5 mm along the approach.
    pad_size_m=(0.0175, 0.0185),
)

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
    # Below half a metre the links shrink so far that the hand, which keeps its size, hits the forearm.
    extension=WristExtension(longest_m=0.05, radius_m=0.02, none_from_reach_m=0.5),
)
