"""A robot's capability map and the spheres of its links, measured from its files."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.tree import KinematicTree
from datagen.workers.motion.arm_links import spheres_along
from datagen.workers.motion.pose_reach import CODES_PER_UNIT, PoseReach
from datagen.workers.motion.reach_cells import AZIMUTHS, DISTANCES, HEIGHTS, ROLLS
from datagen.workers.motion.reach_map import ReachMap, reach_map
from datagen.workers.robots import open_largest, open_robot, robot_limits

_REACH_STEP_M = 0.01
_THICKEST_M = 0.12  # radius of a link of an arm


def reaches_of(name: str) -> F64:
    """The reaches (L,) at which a robot has maps: the ends and whole centimetres of its range, or its own."""
    low, high = robot_limits(name).reach_m
    return np.round(np.linspace(low, high, 1 + round((high - low) / _REACH_STEP_M)), 6)


def measured_arm(name: str, reach_m: float) -> PoseReach:
    """The map of a robot at one of its reaches. InputError as `open_robot`."""
    low, high = robot_limits(name).reach_m
    robot = open_largest(name) if low == high else open_robot(name, reach_m, 0.0)
    return _coded(reach_map(robot.tree.along_z()))


def link_spheres(name: str) -> tuple[KinematicTree, F64]:
    """A robot at its largest, with a frame at each sphere of its moving links, and their radii (B,).

    Links that carry the arm's shoulder, such as torsos and masts, are left out: the base's own clearance is
    a better measure of their room.
    """
    robot = open_largest(name)
    tree = robot.tree.along_z()
    joints, frames, radii = list[int](), list[F64](), list[float]()
    for link, parts in enumerate(robot.link_parts_m[: robot.first_hand_link]):
        if not len(parts) or tree.frame_joint[link] < 0:
            continue
        centers_m, radius_m = spheres_along(np.concatenate(parts))
        if radius_m > _THICKEST_M:
            continue
        for center_m in centers_m:
            frames.append(tree.T_joint_frame[link].copy())
            frames[-1][:3, 3] += frames[-1][:3, :3] @ center_m
        joints += [int(tree.frame_joint[link])] * len(centers_m)
        radii += [radius_m] * len(centers_m)
    frame_joint = np.append(np.array(joints, np.int64), tree.frame_joint[-1])
    T_joint_frame = np.array([*frames, tree.T_joint_frame[-1]])
    return tree._replace(frame_joint=frame_joint, T_joint_frame=T_joint_frame), np.array(radii)


def _coded(reach: ReachMap) -> PoseReach:
    turns = reach.turn >= 0
    count = np.diff(reach.first).reshape(DISTANCES, HEIGHTS, -1, ROLLS, 1 if turns else AZIMUTHS)
    # Hands are often laid at multiples of 45 degrees to the horizontal, the borders of two cells of roll.
    count = count + np.roll(count, 1, axis=3)
    total = 8 * count
    for axis in (0, 1):
        there, here = [slice(None)] * 2, [slice(None)] * 2
        there[axis], here[axis] = slice(1, None), slice(None, -1)
        total[tuple(there)] += count[tuple(here)]
        total[tuple(here)] += count[tuple(there)]
    if not turns:
        total *= AZIMUTHS  # whose cells are as many times smaller
    code = np.rint(CODES_PER_UNIT * np.log1p(total)).clip(0, 255).astype(np.uint8)
    return PoseReach(code.ravel(), reach.axis_xy_m, reach.tcp_wrist_m, turns, reach.half_m)
