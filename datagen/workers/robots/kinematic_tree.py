"""Joints and frames of a robot as plain arrays: all that forward kinematics of any tree needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """J joints, each after the one that carries it, moved by A coordinates, and F frames on them.

    Joint j stands at `ratio[j] * q[coordinate[j]] + offset[j]`: radians where it turns, metres where it slides.
    Joints that share a coordinate move together, such as mimic joints and the segments of a telescope. The last
    frame is the TCP.
    """

    parent: Ints  # (J,), the joint that carries each; -1 is the base
    T_parent_joint: F64  # (J, 4, 4), at position 0
    axis: F64  # (J, 3), unit, joint frame
    slides: Bools  # (J,)
    coordinate: Ints  # (J,)
    ratio: F64  # (J,)
    offset: F64  # (J,)
    lower: F64  # (A,), limits of the coordinates
    upper: F64  # (A,)
    frame_joint: Ints  # (F,), the joint that carries each frame; -1 is the base
    T_joint_frame: F64  # (F, 4, 4)
