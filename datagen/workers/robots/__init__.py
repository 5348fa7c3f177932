"""Robots: a TOML file each. ROBOTS is the registry; `open_robot` opens one of it or a file of the user's."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datagen.schemas.errors import InputError, choices
from datagen.workers.motion.pose_reach import known_arm
from datagen.workers.registry import entry
from datagen.workers.robots.robot_file import RobotSource, read_robot

if TYPE_CHECKING:
    from datagen.workers.robots.gripper import Gripper
    from datagen.workers.robots.robot import Robot

# Names of files beside this one.
ROBOTS: dict[str, str] = {
    "panda-scaled": "panda_scaled.toml",
    "panda": "panda.toml",
    "xarm7": "xarm7.toml",
    "fetch": "fetch.toml",
    "stretch3": "stretch3.toml",
    "tiago-pro": "tiago_pro.toml",
    "ur5": "ur5.toml",
    "pr2": "pr2.toml",
}

# Reaches and heights are stated in whole millimetres.
_STEP_M = 0.001
_HIGHEST_MOUNT_M = 100.0


@dataclass(frozen=True)
class RobotLimits:
    """Ranges that a robot supports. A range whose ends are equal is a single value."""

    reach_m: tuple[float, float]
    base_height_m: tuple[float, float] | None  # None: a pedestal of any height
    base_radius_m: float | None  # its own mobile base; None stands on a pedestal
    # Corners (x, y) of its base's outline in the base frame: origin below the mount, x to the front.
    footprint_m: tuple[tuple[float, float], ...] | None = None
    presents: str = "faces"  # how the base stands to the target
    yaw_rad: float = 0.0  # heading of the base relative to the direction to the target

    @property
    def polygon_m(self) -> tuple[tuple[float, float], ...] | None:
        """The outline of a base that keeps its heading; None for circles: a base that turns sweeps one."""
        return None if self.presents == "turns" else self.footprint_m


def robot_limits(name: str) -> RobotLimits:
    """The ranges of a robot. Raises InputError as `open_robot` does.

    They need no URDF where the file states the reach, and the height and outline of a base, nor for a robot
    of the registry.
    """
    source = robot_source(name)
    keys, base = source.keys, source.keys.base
    if keys.scaled is not None:
        return RobotLimits(keys.scaled.reach_m, None, None)
    reach_m, height_m, radius_m, outline = keys.reach_m, base.height_m, base.outer_radius_m, base.footprint_m
    if base.pedestal and reach_m is not None:
        height_m = radius_m = outline = None
    elif reach_m is None or height_m is None or radius_m is None:
        try:
            robot = _built(source, None)
        except InputError:  # its URDF, or what reads it, is not installed
            if not (known := known_arm(name)):
                raise
            reach_m, (height_m, radius_m) = float(known["reach_m"][0]), known["base_m"].tolist()
            outline = tuple((x, y) for x, y in known["footprint_m"].tolist())
        else:
            reach_m = reach_m or math.ceil(1000 * robot.reach_m) / 1000
            height_m, radius_m, outline = robot.base.height_m, robot.base.radius_m, robot.base.footprint_m
    heights_m = None if height_m is None else (height_m, height_m)
    return RobotLimits((reach_m, reach_m), heights_m, radius_m, outline, base.presents, base.yaw_rad)


def open_robot(name: str, reach_m: float | None, base_height_m: float) -> Robot:
    """A robot at one mount height, by its name in the registry or the path of its file.

    `reach_m` None is the robot's own reach; one that is scaled has none. Raises InputError naming `--robot`
    for an unknown name, a reach or a height outside the robot's range, and naming the file for a key, a URDF
    or a mesh that cannot be used.
    """
    source, limits = robot_source(name), robot_limits(name)
    own = source.keys.scaled is None
    low, high = limits.reach_m
    problem = "is scaled to a reach, but none is given" if reach_m is None and not own else ""
    if reach_m is not None and not low - _STEP_M <= reach_m <= high + _STEP_M:
        problem = f"a reach of {reach_m} m is outside its range"
    if problem:
        raise InputError("--robot", name, problem, _within("reach", low, high))
    bottom, top = limits.base_height_m or (0.0, math.inf)
    # Stored heights are float32, which may lie just outside.
    if not bottom - _STEP_M <= base_height_m <= min(top + _STEP_M, _HIGHEST_MOUNT_M):
        fix = _within("base height", bottom, top)
        raise InputError("--robot", name, f"a base height of {base_height_m} m is outside its range", fix)
    return _mounted(source, None if own else reach_m, min(max(base_height_m, bottom), top))


def gripper_of(name: str) -> Gripper:
    """The gripper of a robot, which is the same at every reach and height."""
    return open_largest(name).gripper


def coordinates_of(name: str) -> int:
    """Number of coordinates that move a robot's arm."""
    return len(open_largest(name).joint_names)


def open_largest(name: str) -> Robot:
    """A robot with its largest reach, on its lowest mount."""
    limits = robot_limits(name)
    height_m = limits.base_height_m[0] if limits.base_height_m else 0.0
    return open_robot(name, limits.reach_m[1], height_m)


def robot_source(name: str, option: str = "--robot") -> RobotSource:
    """The file of a robot: of the registry, or at a path that ends with .toml, or that this process has read.

    The last are named `name@digest`, as a specification does. Raises InputError naming the option for an
    unknown one.
    """
    if name in ROBOTS:
        return read_robot(Path(__file__).parent / ROBOTS[name])
    if name.endswith(".toml"):
        return read_robot(Path(name))
    if name in _read:
        return _read[name]
    plain, _, digest = name.rpartition("@")
    if plain and len(digest) == 64:
        if plain in ROBOTS:
            return remember(plain, plain, digest)
        fix = "Give --robot with the robot's file"
        raise InputError("--robot", plain, "is a robot from a file that was not named", fix)
    fix = f"{choices(ROBOTS, name)}, or give a file: ROBOT.toml"
    raise InputError(option, name or "''", "is unknown", fix)


_read: dict[str, RobotSource] = {}


def robot_digest(name: str) -> str | None:
    """sha256 of all that a robot is made from; None where ManiSkill brings its files, by their version."""
    source = robot_source(name)
    if name in ROBOTS and source.keys.urdf.startswith("package:mani_skill/"):
        return None
    return _digest(source)


def remember(place: str, name: str, digest: str) -> RobotSource:
    """Read the robot at a place, under the name and digest of a specification. InputError for another one."""
    source = robot_source(place)
    found = _digest(source)
    if found != digest or source.name != name:
        problem = f"holds {source.name} {found[:12]}, but the run was made with {name} {digest[:12]}"
        fix = "Give the file that the run was started with, under that name, or start a new run"
        raise InputError("--robot", place, problem, fix)
    _read[f"{name}@{digest}"] = source
    return source


@lru_cache(maxsize=64)
def _digest(source: RobotSource) -> str:
    return _code("assembly:content_digest")(source)


@lru_cache(maxsize=64)
def _mounted(source: RobotSource, reach_m: float | None, base_height_m: float) -> Robot:
    # Pedestals of any height carry the same arm.
    return _built(source, reach_m).at_height(base_height_m)


# A scaled arm has fewer reaches in whole centimetres.
@lru_cache(maxsize=128)
def _built(source: RobotSource, reach_m: float | None) -> Robot:
    return _code("robot:Robot")(source, reach_m)


def _code(name: str) -> Callable[..., Any]:
    # Imported on first use, so that names can be read without a simulator.
    return entry({"robots": f"datagen.workers.robots.{name}"}, "robots", "--robot")


def _within(what: str, low: float, high: float) -> str:
    if math.isinf(high):
        return f"Give a {what} of at least {low} m"
    return f"Give a {what} of {low} m" if low == high else f"Give a {what} from {low} to {high} m"
