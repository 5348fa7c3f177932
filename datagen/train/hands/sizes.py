"""Sizes of a robot's hand as `hand_poses` lays it at a target.

The Franka Hand's sizes are those that the first models were trained with, which were read off its shapes by
eye. Another hand's differ from them by as much as its measured shapes differ from the Franka Hand's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from datagen.train.inputs import F64
from datagen.workers.motion.pose_reach import known_arm
from datagen.workers.robots import gripper_of
from datagen.workers.robots.gripper import Gripper

Pairs = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class HandSize:
    """A parallel hand in its TCP frame: z is the approach, the fingers close along y. Lengths in metres."""

    stroke_m: float = 0.08
    pad_m: float = 0.011  # half the width of a finger
    tip_m: float = 0.0095  # from the TCP to the fingertips, along the approach
    finger_m: float = 0.015  # thickness of a finger, along the closing axis
    palm_m: tuple[float, float] = (0.033, 0.105)  # half sizes of the palm across the approach
    palm_near_m: float = -0.0364
    palm_far_m: float = -0.13
    # Centres of the parts' spheres along the approach, and for the palm along the closing axis too.
    finger_z_m: tuple[float, ...] = (-0.045, -0.03, -0.015, 0.0)
    palm_yz_m: Pairs = tuple((y, z) for z in (-0.066, -0.1) for y in (-0.08, -0.04, 0.0, 0.04, 0.08))
    wrist_z_m: tuple[float, ...] = (-0.17, -0.22, -0.28)
    finger_radius_m: float = 0.009
    palm_radius_m: float = 0.03


FRANKA = HandSize()
# `measured_hand` of the Franka Hand: stroke, half pad, tips, thickness, palm's half sizes, near and far end.
_FRANKA_MEASURED = np.array([0.08, 0.0088, 0.0095, 0.0152, 0.0324, 0.1029, -0.0364, -0.1303])
_DIGITS = 4  # of measures in metres


@lru_cache(maxsize=64)
def hand_size(robot: str) -> HandSize:
    """The hand of a robot, by its name or file. InputError as `open_robot`."""
    known = known_arm(robot)
    measured = known["hand"] if known else measured_hand(gripper_of(robot))
    more = np.round(np.round(measured, _DIGITS) - _FRANKA_MEASURED, _DIGITS)
    stroke, pad, tip, finger, across, closing, near, far = (more + 0.0).tolist()
    if not more.any():
        return FRANKA
    own, palm_y = FRANKA, max(0.08 + closing, 0.0)
    return HandSize(
        own.stroke_m + stroke,
        own.pad_m + pad,
        own.tip_m + tip,
        own.finger_m + finger,
        (own.palm_m[0] + across, own.palm_m[1] + closing),
        own.palm_near_m + near,
        own.palm_far_m + far,
        tuple(z + near * share for z, share in zip(own.finger_z_m, (1.0, 2 / 3, 1 / 3, 0.0), strict=True)),
        tuple(
            (palm_y * share, z) for z in (-0.066 + near, -0.1 + far) for share in (-1.0, -0.5, 0.0, 0.5, 1.0)
        ),
        tuple(z + far for z in own.wrist_z_m),
        own.finger_radius_m + (finger + 2 * pad) / 4,
        own.palm_radius_m + min(across, 0.07 + closing),  # of the palm's narrower side
    )


def measured_hand(gripper: Gripper) -> F64:
    """Measures (8,) as `_FRANKA_MEASURED` with the fingers half open, where hands of joints hold objects."""
    opening_m = gripper.max_opening_m / 2
    finger = [part.astype(np.float64) for part in gripper.fingers_near(opening_m)[0]]
    palm = np.concatenate(gripper.palm_parts_m)
    depth_m = float(gripper.pad_depth_m(np.array([opening_m]))[0])
    y = np.concatenate([_slice(part, depth_m)[:, 1] for part in finger])
    thick_m = float(np.ptp(y)) if len(y) else _FRANKA_MEASURED[3]
    tip_m = max(float(part[:, 2].max()) for part in finger)
    half = np.ptp(palm[:, :2], axis=0) / 2
    ends = (-gripper.palm_depth_m, float(palm[:, 2].min()))
    return np.array([gripper.max_opening_m, gripper.pad_size_m[0] / 2, tip_m, thick_m, *half, *ends])


def _slice(part: F64, z: float) -> F64:
    """Points (M, 3) of a convex part's corners (V, 3) and edges at a height, which span its section there."""
    below, above = part[part[:, 2] <= z], part[part[:, 2] >= z]
    rise = above[:, None, 2] - below[:, 2]
    share = np.divide(z - below[:, 2], rise, out=np.zeros_like(rise), where=rise > 0)
    return (below + share[..., None] * (above[:, None] - below)).reshape(-1, 3)
