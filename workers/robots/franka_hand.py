"""The Franka hand, as ManiSkill's `panda_v2.urdf` describes it: two fingers that open to 8 cm."""

from __future__ import annotations

from datagen.workers.geometry.transforms import translation
from datagen.workers.robots.description import HandDescription

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
