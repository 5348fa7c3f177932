"""How easily the robots' own arms bring their hands to the poses at a target, from each candidate.

And how much room the arm's links have there in the observed cloud: for each pose the joint vector of a cell
near it stands for the arm; its spheres are moved so that the wrist is where the pose wants it, the further
along the arm the more. A planner finds other joint vectors, and sees what the cloud does not: the model
learns what the room is worth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from datagen.train.hands.poses import N_MEASURES, DistanceGrid
from datagen.train.hands.sizes import HandSize, hand_size
from datagen.train.inputs import F32, F64, I64, U8, Array, Bools, CandidateInputs, Clouds, RobotInputs
from datagen.workers.motion.arm_links import ArmLinks, arm_links, cells_at, to_front
from datagen.workers.motion.pose_reach import N_STAGES, WAY_M, PoseReach, pose_reach, reach_codes
from datagen.workers.motion.reach_cells import DISTANCES, HEIGHTS, cells_of

# Assumed where labels or a frame name no robot: an arm of that reach with a Franka Hand.
UNKNOWN_ROBOT = "panda-scaled"
N_ROOMS = 2  # codes of a pose: at the grasp, and above it
N_CODES = N_STAGES + N_ROOMS
Text = npt.NDArray[np.str_]


def names_of(robots: RobotInputs[Array]) -> Text:
    """Names (R,) of robots, UNKNOWN_ROBOT for those without."""
    names = np.full(len(robots), "") if robots.name is None else np.asarray(robots.name)
    return np.where(names == "", UNKNOWN_ROBOT, names)


def hands_of(robots: RobotInputs[Array], n_clouds: int) -> list[HandSize]:
    """The hand (S,) at each cloud's target: that of the cloud's robots, which are of one kind."""
    name_of = np.full(n_clouds, UNKNOWN_ROBOT, object)
    name_of[robots.cloud_row] = names_of(robots)
    return [hand_size(str(name)) for name in name_of]


def hand_reach(
    poses: F32,
    clouds: Clouds[Array],
    robots: RobotInputs[Array],
    candidates: CandidateInputs[Array],
    rise_m: F32,
) -> U8:
    """Codes (N, K, N_CODES) for poses (S, K, HAND_WIDTH): of `reach_codes`, then of `room_codes`.

    `rise_m` (R,) is the height of the target's centre above the mount.

    Raises InputError where a robot's files are missing.
    """
    axes = poses[..., N_MEASURES:].reshape(*poses.shape[:2], 3, 3).astype(np.float64)
    row = candidates.robot_row.astype(np.int64)
    turn_rad = np.zeros(len(row)) if candidates.turn_rad is None else candidates.turn_rad
    found, around = np.zeros((len(row), poses.shape[1], N_CODES), np.uint8), obstacles(clouds)
    arms = [(str(n), round(float(r), 2)) for n, r in zip(names_of(robots), robots.arm_reach_m, strict=True)]
    for arm in dict.fromkeys(arms):
        some = np.flatnonzero(np.array([each == arm for each in arms])[row])
        where: Bases = (
            robots.cloud_row[row[some]].astype(np.int64),
            candidates.base_xy_m[some].astype(np.float64),
            turn_rad[some].astype(np.float64),
            rise_m[row[some]].astype(np.float64),
        )
        reach = reach_codes(pose_reach(*arm), axes, *where)
        rooms = room_codes(pose_reach(*arm), arm_links(arm[0]), around, axes, reach, where)
        found[some] = np.concatenate([reach, rooms], axis=2)
    return found


_POSES = 16  # of a candidate: the best that its arm can reach
_MOST_ROOM_M, _BEYOND_M = 0.08, 0.2
_CELL_M, _AROUND_M = 0.025, np.array([1.0, 1.0, 0.8])
_AT_ONCE = 256  # bases in one pass: bounds memory


def obstacles(clouds: Clouds[Array]) -> list[DistanceGrid]:
    """Distances to the observed points of each cloud (S,) but for its target's."""
    shape = tuple(np.rint(2 * _AROUND_M / _CELL_M).astype(int).tolist())
    return [
        DistanceGrid(points_m[:n][~mask[:n]], -_AROUND_M, shape, _CELL_M)
        for points_m, mask, n in zip(clouds.points_m, clouds.target_mask, clouds.n_points, strict=True)
    ]


# Of N bases as in `reach_codes`: rows of their poses, positions (N, 2), turns and rises.
Bases = tuple[I64, F64, F64, F64]


def room_codes(
    arm: PoseReach, links: ArmLinks, around: Sequence[DistanceGrid], axes: F64, reach: U8, bases: Bases
) -> U8:
    """Codes (N, K, N_ROOMS) of K poses from each of N bases: 1 to 255 for -8 to 8 cm, 0 where unknown.

    `around` (S,) has each cloud's obstacles and `reach` (N, K, N_STAGES) the poses' codes of reach; others
    as in `reach_codes`.
    """
    found = np.zeros((*reach.shape[:2], N_ROOMS), np.uint8)
    able = reach.min(axis=2) > 0
    able &= np.cumsum(able, axis=1) <= _POSES
    for start in range(0, len(reach), _AT_ONCE):
        n, k = np.nonzero(able[start : start + _AT_ONCE])
        n += start
        some: Bases = bases[0][n], bases[1][n], bases[2][n], bases[3][n]
        hands = np.moveaxis(axes[some[0], k], 0, 2)  # (3 of TCP, approach and closing axis, 3, Q)
        found[n, k] = _rooms(arm, links, around, hands, some)
    return found


def _rooms(arm: PoseReach, links: ArmLinks, around: Sequence[DistanceGrid], hands: F64, bases: Bases) -> U8:
    cloud, base_xy_m, turn_rad, rise_m = bases
    yaw = np.arctan2(-base_xy_m[:, 1], -base_xy_m[:, 0]) + turn_rad
    mount = np.stack([*base_xy_m.T, -rise_m])
    tcp, a, b = to_front(yaw, hands[0] - mount), to_front(yaw, hands[1]), to_front(yaw, hands[2])
    tcp[:2] -= arm.axis_xy_m[:, None]
    across = np.cross(b, a, axis=0)
    scale, found = arm.half_m / links.half_m, np.zeros((len(cloud), N_ROOMS), np.uint8)
    u, v, w = arm.tcp_wrist_m
    for stage, up_m in enumerate((0.0, WAY_M)):
        for roll in (1.0, -1.0):
            at = tcp + roll * u * across + roll * v * b + w * a
            at[2] += up_m
            planar, azimuth = np.hypot(at[0], at[1]), np.arctan2(at[1], at[0])
            direction = cells_of(
                to_front(azimuth, a), to_front(azimuth, roll * b), None if arm.turns else azimuth
            )
            some, row = _chosen(arm, links, planar, at[2], azimuth, direction)
            p = np.moveaxis(links.center_m[row].astype(np.float64) * scale, 2, 0)  # (3, Q', B)
            away_m = np.stack([planar[some], at[2, some]], axis=1) - links.wrist_m[row] * scale
            p[[0, 2]] += away_m.T[:, :, None] * links.along
            p = to_front(-azimuth[some, None], p)
            p[:2] += arm.axis_xy_m[:, None, None]
            p = np.moveaxis(to_front(-yaw[some, None], p) + mount[:, some, None], 0, 2)
            distance_m = np.empty(p.shape[:2], np.float32)
            for each in np.unique(cloud[some]):
                of = cloud[some] == each
                distance_m[of] = around[each](p[of], _BEYOND_M)
            room = (distance_m - links.radius_m * scale).min(axis=1, initial=_BEYOND_M)
            code = 1 + np.rint((room / _MOST_ROOM_M + 1).clip(0, 2) * 127).astype(np.uint8)
            found[some, stage] = np.maximum(found[some, stage], code)
    return found


def _chosen(
    arm: PoseReach, links: ArmLinks, planar_m: F64, height_m: F64, azimuth: F64, direction: I64
) -> tuple[I64, I64]:
    """Rows of those wrists (Q,) near which there is a joint vector within its limits, and of these vectors.

    The wrist's own cell is asked first, then the nearest ones in distance, in height and in both.
    """
    step_m = np.array([1 / DISTANCES, 2 / HEIGHTS]) * arm.half_m
    own = np.stack([planar_m, height_m + arm.half_m]) / step_m[:, None]
    side = np.where(own % 1 > 0.5, 1, -1) * step_m[:, None]
    found = np.full(len(planar_m), -1)
    low, high = links.turn_limits_rad
    for more, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
        cell = cells_at(arm, planar_m + more * side[0], height_m + up * side[1], direction)
        row = np.searchsorted(links.cell, cell).clip(max=len(links.cell) - 1)
        fits: Bools = links.cell[row] == cell
        if np.isfinite(low):
            turn = links.turn_rad[row] + azimuth
            fits &= turn - 2 * np.pi * np.floor((turn - low) / (2 * np.pi)) <= high
        found = np.where((found < 0) & fits, row, found)
    some = np.flatnonzero(found >= 0)
    return some, found[some]
