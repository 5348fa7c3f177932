"""Reachability map of an arm: directions from which its hand reaches a point at a distance and height.

Zacharias et al. 2007, "Capturing robot workspace structure: representing robot capabilities" (IROS), divide
an arm's workspace into cells, and directions of approach into parts of a sphere. Here cells are rings around
the vertical through the mount: the base may turn, so that only distance, height and the approach's direction
relative to the target's count (Vahrenkamp et al. 2013, "Robot placement based on reachability inversion").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from datagen.train.inputs import F32, F64, Bools
from datagen.workers.grasps.contacts import perpendicular
from datagen.workers.kinematics.tree import frame_poses
from datagen.workers.motion.reachable_set import AZIMUTHS, LEVELS, direction_parts, part_directions
from datagen.workers.robots import gripper_of, open_robot, robot_limits
from datagen.workers.robots.gripper import Gripper

# Length of the hand's last way, a straight line; the default of `motion.pregrasp_m`.
PREGRASP_M = 0.08
_SAMPLES, _AT_ONCE = 1 << 18, 1 << 15
_CELLS_PER_REACH = 16
_SEED = 0x3EAC
# Scaled arms share the map of the next tenth of a metre, with their reach as unit.
_STEP_M = 0.1


@dataclass(frozen=True, eq=False)
class ReachabilityMap:
    """Whether the hand reaches a position from a pregrasp, by ring of positions and part of directions.

    Distances from the vertical through the mount begin at 0, heights at `lowest` below it; both are in cells
    of a share of the reach. A direction's azimuth is 0 where it points away from the robot.
    """

    reachable: F32  # (D, H, LEVELS, AZIMUTHS), 0 to 1
    lowest: float  # in units of the reach
    gripper: Gripper
    cells_per_reach: float = _CELLS_PER_REACH

    def at(self, distance: F64, height: F64) -> F32:
        """Reachability (N, LEVELS, AZIMUTHS) at distances and heights (N,), in units of the reach.

        Between the cells' centres it is bilinear, beyond the map 0.
        """
        row = distance * self.cells_per_reach - 0.5
        column = (height - self.lowest) * self.cells_per_reach - 0.5
        found = np.zeros((len(row), LEVELS, AZIMUTHS), np.float32)
        rings, heights = self.reachable.shape[:2]
        for i in (np.floor(row), np.floor(row) + 1):
            for j in (np.floor(column), np.floor(column) + 1):
                weight = np.maximum(1 - np.abs(row - i), 0) * np.maximum(1 - np.abs(column - j), 0)
                inside = (i < rings) & (j >= 0) & (j < heights)
                # Nearer than half a cell to the vertical, the first ring counts alone.
                cells = self.reachable[np.clip(i[inside], 0, None).astype(int), j[inside].astype(int)]
                found[inside] += weight[inside, None, None].astype(np.float32) * cells
        return found


def reachability_map(robot: str, reach_m: float) -> ReachabilityMap:
    """The map of a robot of the registry with that reach (m). InputError where its files are missing."""
    # Needs the compiler, as other parts of the arm do.
    from datagen.workers.motion.reachable_sampling import needs_set

    low, high = robot_limits(robot).reach_m
    if needs_set(robot):
        return _of_set(robot)
    if low == high:
        return _map(robot, None)
    return _map(robot, float(np.clip(np.ceil(reach_m / _STEP_M - 0.01) * _STEP_M, low, high)))


@lru_cache(maxsize=8)
def _of_set(name: str) -> ReachabilityMap:
    """That of a robot that is judged by its reachable set: where it has the target as it presents itself."""
    from datagen.workers.motion.reachable_sampling import reachable_set_of

    found, limits = reachable_set_of(name), robot_limits(name)
    there = found.directions_at(-limits.yaw_rad)
    reach_m = limits.reach_m[0]
    poses = ReachabilityMap(there, found.lowest_m / reach_m, gripper_of(name), reach_m / found.cell_m)
    return replace(poses, reachable=there * _backed(poses, PREGRASP_M / reach_m))


@lru_cache(maxsize=32)
def _map(name: str, reach_m: float | None) -> ReachabilityMap:
    heights = robot_limits(name).base_height_m
    robot = open_robot(name, reach_m, heights[0] if heights else 0.0)
    lower, upper = np.maximum(robot.q_lower_rad, -np.pi), np.minimum(robot.q_upper_rad, np.pi)
    rng = np.random.default_rng(_SEED)
    lowest = float(robot.shoulder_m[2]) / robot.reach_m - 1
    size = (_CELLS_PER_REACH, 2 * _CELLS_PER_REACH, LEVELS, AZIMUTHS)
    count = np.zeros(size, np.int64)
    for _ in range(_SAMPLES // _AT_ONCE):
        T = frame_poses(robot.tree, rng.uniform(lower, upper, (_AT_ONCE, len(lower))), tcp_only=True)[:, 0]
        x, y, z = (T[:, k, 3] / robot.reach_m for k in range(3))
        ring = np.hypot(x, y) * _CELLS_PER_REACH
        level, azimuth = direction_parts(T[:, :3, 2], np.arctan2(y, x))
        cells = (ring, (z - lowest) * _CELLS_PER_REACH, level, azimuth)
        cells = tuple(np.clip(c.astype(np.int64), 0, n - 1) for c, n in zip(cells, size, strict=True))
        np.add.at(count, cells, 1)
    poses = ReachabilityMap((count > 0).astype(np.float32), lowest, robot.gripper)
    return replace(poses, reachable=poses.reachable * _backed(poses, PREGRASP_M / robot.reach_m))


def _backed(poses: ReachabilityMap, back: float) -> F32:
    """Reachability (D, H, LEVELS, AZIMUTHS) of the pose that lies `back` behind each one of the map."""
    rings, heights = poses.reachable.shape[:2]
    distance = np.repeat((np.arange(rings) + 0.5) / poses.cells_per_reach, heights)
    height = np.tile((np.arange(heights) + 0.5) / poses.cells_per_reach + poses.lowest, rings)
    found = np.empty((rings * heights, LEVELS, AZIMUTHS), np.float32)
    directions = part_directions()
    for level, azimuth in np.ndindex(*directions.shape[:2]):
        x, y, z = directions[level, azimuth]
        # The hand moves along a line: behind, its direction is the same, its azimuth from the mount is not.
        behind = np.hypot(distance - back * x, back * y)
        turn = np.arctan2(-back * y, distance - back * x) / (2 * np.pi) * AZIMUTHS
        seen = (azimuth - np.round(turn).astype(int)) % AZIMUTHS
        found[:, level, azimuth] = poses.at(behind, height - back * z)[np.arange(len(seen)), level, seen]
    return found.reshape(poses.reachable.shape)


_ROLLS = 4  # in half a turn about the approach: the hand is the same after half a turn
# Stored clouds have a point every 2 to 3 cm: without a margin a finger fits between them.
_ROOM_M = 0.01


def free_approaches(others_m: F32, directions: F64, gripper: Gripper) -> Bools:
    """Mask (...,) of approach directions (..., 3) that are free at some roll of the hand.

    `others_m` (P, 3) are all points but the target's, in the target's frame. The hand's middle goes to its
    origin. Palm and fingers are boxes with a margin, extended backwards over the last way. Unobserved space
    is free.
    """
    boxes = _boxes(gripper)
    far_m = float(np.linalg.norm(np.abs(boxes).max((0, 1))))
    near = others_m[np.linalg.norm(others_m, axis=1) <= far_m]  # also drops points that are not finite
    axes = _rolled(directions.reshape(-1, 3)).astype(np.float32)  # (A, _ROLLS, 3, 3)
    x, y, z = np.moveaxis(near @ axes, -1, 0)  # (A, _ROLLS, P) each
    free: Bools = np.ones(axes.shape[:2], np.bool_)
    for low, high in boxes:
        inside = (z > low[2]) & (z < high[2])
        inside &= (x > low[0]) & (x < high[0])
        inside &= (y > low[1]) & (y < high[1])
        free &= ~inside.any(2)
    return np.asarray(free.any(axis=1)).reshape(directions.shape[:-1])


def _boxes(gripper: Gripper) -> F64:
    """(3, 2, 3): lowest and highest corners of the palm and the fingers in the TCP frame."""
    n = len(gripper.palm_parts_m)
    parts = gripper.parts_at(gripper.max_opening_m)
    fingers = len(gripper.finger_parts_m[0])
    groups = (parts[:n], parts[n : n + fingers], parts[n + fingers :])
    corners = [np.concatenate(group) for group in groups]
    boxes = np.array([[c.min(0) - _ROOM_M, c.max(0) + _ROOM_M] for c in corners], np.float64)
    boxes[:, 0, 2] -= PREGRASP_M
    return boxes


def _rolled(z: F64) -> F64:
    """Axes (A, _ROLLS, 3, 3), as columns, of hands that approach along unit vectors (A, 3)."""
    aside, up = perpendicular(z)
    angle = (np.pi * np.arange(_ROLLS) / _ROLLS)[:, None]
    x: F64 = np.cos(angle) * aside[:, None] + np.sin(angle) * up[:, None]
    along = np.broadcast_to(z[:, None], x.shape)
    y: F64 = np.cross(along, x)
    return np.stack([x, y, along], axis=3)
