"""How easily the robots' own arms bring their hands to the poses at a target, from each candidate."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datagen.train.hands.links import N_ROOMS, Bases, obstacles, room_codes
from datagen.train.hands.poses import N_MEASURES
from datagen.train.hands.sizes import HandSize, hand_size
from datagen.train.inputs import F32, U8, Array, CandidateInputs, Clouds, RobotInputs
from datagen.workers.motion.arm_links import arm_links
from datagen.workers.motion.pose_reach import N_STAGES, pose_reach, reach_codes

# Assumed where labels or a frame name no robot: an arm of that reach with a Franka Hand.
UNKNOWN_ROBOT = "panda-scaled"
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
