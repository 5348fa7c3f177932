"""Robots: one file of cited constants each. ROBOTS is the registry; `open_robot` opens one."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

from datagen.schemas.errors import InputError
from datagen.workers.registry import entry
from datagen.workers.robots.description import RobotDescription, RobotLimits

if TYPE_CHECKING:
    from datagen.workers.robots.description import Gripper
    from datagen.workers.robots.robot import Robot

ROBOTS: dict[str, str] = {
    "panda-scaled": "datagen.workers.robots.panda:PANDA_SCALED",
    "panda": "datagen.workers.robots.panda:PANDA",
    "xarm7": "datagen.workers.robots.xarm7:XARM7",
    "fetch": "datagen.workers.robots.fetch:FETCH",
}

# Reaches and heights are stated in whole millimetres.
_STEP_M = 0.001
_HIGHEST_MOUNT_M = 100.0


def robot_limits(name: str) -> RobotLimits:
    """The ranges of a robot, from constants only. Raises InputError for an unknown name."""
    return _description(name).limits


def open_robot(name: str, reach_m: float | None, base_height_m: float) -> Robot:
    """A robot of the registry at one mount height; the last 64 are kept.

    `reach_m` None is the robot's own reach; `panda-scaled` has none. Raises InputError naming
    `--robot` for an unknown name, a reach or a height outside the robot's range, and naming the file
    for a URDF or a mesh that cannot be used.
    """
    description = _description(name)
    own = description.extension is None
    low, high = description.limits.reach_m
    problem = "is scaled to a reach, but none is given" if reach_m is None and not own else ""
    if reach_m is not None and not low - _STEP_M <= reach_m <= high + _STEP_M:
        problem = f"a reach of {reach_m} m is outside its range"
    if problem:
        raise InputError("--robot", name, problem, _within("reach", low, high))
    bottom, top = description.limits.base_height_m or (0.0, math.inf)
    # Stored heights are float32, which may lie just outside.
    if not bottom - _STEP_M <= base_height_m <= min(top + _STEP_M, _HIGHEST_MOUNT_M):
        fix = _within("base height", bottom, top)
        raise InputError("--robot", name, f"a base height of {base_height_m} m is outside its range", fix)
    return _mounted(name, None if own else reach_m, min(max(base_height_m, bottom), top))


def gripper_of(name: str) -> Gripper:
    """The gripper of a robot, which is the same at every reach and height."""
    limits = robot_limits(name)
    height_m = limits.base_height_m[0] if limits.base_height_m else 0.0
    return open_robot(name, limits.reach_m[1], height_m).gripper


def _description(name: str) -> RobotDescription:
    return entry(ROBOTS, name, "--robot")


@lru_cache(maxsize=64)
def _mounted(name: str, reach_m: float | None, base_height_m: float) -> Robot:
    if _description(name).lift is not None:
        return _built(name, reach_m, base_height_m)
    # Pedestals of any height carry the same arm.
    return _built(name, reach_m, 0.0).at_height(base_height_m)


# A scaled arm has fewer reaches in whole centimetres.
@lru_cache(maxsize=128)
def _built(name: str, reach_m: float | None, base_height_m: float) -> Robot:
    # Imported on first use, so that limits can be read without a simulator.
    build = entry({name: "datagen.workers.robots.robot:Robot"}, name, "--robot")
    return build(_description(name), reach_m, base_height_m)


def _within(what: str, low: float, high: float) -> str:
    if math.isinf(high):
        return f"Give a {what} of at least {low} m"
    return f"Give a {what} of {low} m" if low == high else f"Give a {what} from {low} to {high} m"
