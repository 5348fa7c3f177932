"""Fetch of ManiSkill's `fetch.urdf`: an arm on a torso that lifts, on a mobile base, with its own gripper."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.transforms import translation
from datagen.workers.robots.description import HandDescription, RobotDescription, RobotLimits, TorsoLift

FETCH_HAND = HandDescription(
    name="fetch-gripper",
    urdf="fetch/fetch.urdf",
    palm_link="gripper_link",
    finger_joints=("r_gripper_finger_joint", "l_gripper_finger_joint"),
    # The origin of gripper_link lies between the fingers; its x axis points out of the palm.
    T_palm_tcp=np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]),
    # Extents of r_gripper_finger_link.STL across the fingers and along the approach.
    pad_size_m=(0.0264, 0.06),
)

_LEFT_FOLDS = (
    (1.24, 1.42, -0.19, 1.78, 0.1, 1.42, 1.17),  # beside the torso, hanging
    (1.5, -1.12, 3.01, 1.37, -0.77, 1.52, -2.79),  # beside the torso, raised
    (0.58, 1.42, -0.74, 2.15, 0.52, 0.94, 0.51),  # over the base
)
# Fetch is the same on both sides: joints that turn about x or z change sign.
_FOLDS = tuple(
    (fold, tuple(s * q for s, q in zip((-1, 1, -1, 1, -1, 1, -1), fold, strict=True))) for fold in _LEFT_FOLDS
)

# Half of the outline of base_link_collision.STL around shoulder_pan_joint, which lies 0.03265 m ahead of the
# base's middle: the sixteen sides that hold its hull, corners rounded outwards to millimetres.
_LEFT_OUTLINE_M = (
    (0.254, 0.058),
    (0.210, 0.163),
    (0.135, 0.239),
    (0.073, 0.265),
    (-0.139, 0.265),
    (-0.201, 0.239),
    (-0.277, 0.164),
    (-0.320, 0.059),
)

FETCH = RobotDescription(
    name="fetch",
    urdf="fetch/fetch.urdf",
    # The joints above it, which drive the base over the floor, are left out: the base is fixed.
    root_link="base_link",
    arm_joints=(
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "upperarm_roll_joint",
        "elbow_flex_joint",
        "forearm_roll_joint",
        "wrist_flex_joint",
        "wrist_roll_joint",
    ),
    flange_link="wrist_roll_link",
    T_flange_palm=translation(0.16645, 0.0, 0.0),  # gripper_axis
    hand=FETCH_HAND,
    homes_rad=tuple(fold for pair in _FOLDS for fold in pair),
    # Fetch.arm_stiffness, arm_damping, arm_force_limit in mani_skill/agents/robots/fetch/fetch.py
    stiffness=1e3,
    damping=1e2,
    force_limit_n=100.0,
    limits=RobotLimits(
        # Largest distance from the origin of shoulder_pan_joint to the TCP.
        reach_m=(1.11, 1.11),
        # Heights of shoulder_pan_joint above the floor over torso_lift_joint's range, 0 to 0.38615 m.
        base_height_m=(0.727, 1.112),
        # Radius of the base's hull around shoulder_pan_joint's axis, which is not its middle.
        base_radius_m=0.32,
        footprint_m=_LEFT_OUTLINE_M + tuple((x, -y) for x, y in reversed(_LEFT_OUTLINE_M)),
    ),
    # torso_lift_joint and shoulder_pan_joint, 0.37743 + 0.34858 m; base_link stands on the floor.
    lift=TorsoLift(joint="torso_lift_joint", mount_at_zero_m=0.72601),
    # The arm turns between a shelf and a neck that protrude from the link.
    cuts_m={"torso_lift_link": (0.18, 0.304, 0.47)},
    # The wheels lie within the base's outline, and their treads reach 5 mm into the floor.
    shapeless=("r_wheel_link", "l_wheel_link"),
    held={"head_pan_joint": 0.0, "head_tilt_joint": 0.0},
)
