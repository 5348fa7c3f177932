"""The robot of `plan` and `sim` labels in a specification, and candidates that suit it."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pydantic import ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.specification import (
    ArmParams,
    CandidateParams,
    DisturbanceParams,
    Range,
    Specification,
    Turns,
)
from datagen.workers.bases.candidates import footprint_of
from datagen.workers.engine_versions import ARM_PACKAGES
from datagen.workers.extras import how_to_get
from datagen.workers.robots import coordinates_of, remember, robot_digest, robot_limits, robot_source

Fields = dict[str, Any]

# Sections of the arm that only some label sources have.
_NOT_FOR: dict[str, tuple[str, ...]] = {"plan": ("trial",), "sim": ()}
# Reaches are stated in whole millimetres.
_STEP_M, _SAME_RAD = 0.001, 1e-6
# Step between sampled reaches: opening an arm of another reach costs as much as planning ten candidates.
REACH_STEP_M = 0.01
_NEARBY_ROUNDS = 3  # of the search near failed grasps


def refuse_missing_packages(label_source: str) -> None:
    """Raise InputError where the label source needs libraries that are not installed."""
    for name in ARM_PACKAGES.get(label_source, ()):
        try:
            version(name)
        except PackageNotFoundError:
            raise InputError(
                "label source", label_source, f"needs {name}, not installed", how_to_get("sim")
            ) from None


def complete_arm(
    label_source: str,
    fields: Fields,
    robot: str | None,
    repeats: int | None,
    place: str,
    draws: int | None = None,
) -> None:
    """Fill in the section `arm` of a specification's fields for this label source.

    `robot`, `repeats` and `draws` are the options --robot, --perturb and --draws, and override the section
    that came from `place`. Raises InputError for what the label source does not support.
    """
    if draws is not None and (label_source != "plan" or repeats is not None):
        problem = "is for plan labels without --perturb"
        raise InputError("--draws", str(draws), problem, "Omit one of them, or submit plan")
    if draws is not None and not 2 <= draws <= 100:
        raise InputError("--draws", str(draws), "is not 2 to 100", "Omit it for one draw")
    if repeats is not None and label_source not in ARM_PACKAGES:
        fix = "Omit it, or submit plan or sim"
        raise InputError("--perturb", str(repeats), f"{label_source} has no arm", fix)
    if repeats is not None:
        try:
            DisturbanceParams(repeats=repeats)
        except ValidationError as error:
            problem = error.errors()[0]["msg"]
            raise InputError("--perturb", str(repeats), problem, "Omit it for undisturbed labels") from None
    if label_source not in ARM_PACKAGES:
        if "arm" in fields:
            raise InputError(place, "arm", f"{label_source} has no arm", "Remove the section")
        return
    arm = fields.setdefault("arm", {})
    if not isinstance(arm, dict):
        return  # the specification refuses it
    for section in _NOT_FOR[label_source]:
        if section in arm:
            problem = f"{label_source} runs no trials"
            raise InputError(place, f"arm.{section}", problem, "Remove the section, or submit sim")
    named = arm.get("robot", ArmParams().robot) if robot is None else robot
    if isinstance(named, str):
        is_known = robot is None and "robot_digest" in arm
        key = f"{named}@{arm['robot_digest']}" if is_known else named
        put_robot(arm, key, f"{place}: arm.robot" if robot is None else "--robot")
    motion = arm.setdefault("motion", {})
    if isinstance(motion, dict):
        motion.setdefault("nearby_rounds", _NEARBY_ROUNDS)
    if label_source == "sim":
        arm.setdefault("trial", {})
    if draws is not None:
        arm["draws"] = draws
    if repeats is not None:
        disturbance = arm.setdefault("disturbance", {})
        if isinstance(disturbance, dict):
            disturbance["repeats"] = repeats


def put_robot(arm: Fields, name: str, option: str = "--robot") -> None:
    """Set the robot of the section `arm`, and what labels depend on. InputError for an unknown one."""
    source = robot_source(name, option)
    digest = robot_digest(name)
    if digest is not None:
        remember(name, source.name, digest)
    count = coordinates_of(name)
    known = {"robot": source.name, "robot_digest": digest, "joints": None if count == 7 else count}
    for key, value in known.items():
        if value is None:
            arm.pop(key, None)
        else:
            arm[key] = value


def robot_of(fields: Fields, robot: str | None) -> str | None:
    """The robot that candidates must suit: --robot, or that of the arm; None for any."""
    arm = fields.get("arm")
    if robot is not None or not isinstance(arm, dict):
        return robot
    named, digest = arm.get("robot", ArmParams().robot), arm.get("robot_digest")
    return None if not isinstance(named, str) else named if digest is None else f"{named}@{digest}"


def narrow_candidates(fields: Fields, robot: str) -> None:
    """Narrow the ranges that the fields do not set to those of the robot. InputError for an unknown one."""
    limits, defaults = robot_limits(robot), CandidateParams()
    candidates = fields.setdefault("candidates", {})
    if not isinstance(candidates, dict):
        return
    if limits.reach_m[0] < limits.reach_m[1]:
        candidates.setdefault("arm_reach_step_m", REACH_STEP_M)
    candidates.setdefault("arm_reach_m", _narrowed(defaults.arm_reach_m, limits.reach_m))
    if limits.base_height_m is not None:
        candidates.setdefault("base_height_m", _narrowed(defaults.base_height_m, limits.base_height_m))
    if limits.base_radius_m is not None:
        candidates.setdefault("base_radius_m", limits.base_radius_m)
    if limits.polygon_m is not None:
        candidates.setdefault("footprint_m", limits.polygon_m)
    if limits.presents == "side":
        candidates.setdefault("yaw_rad", {"low": limits.yaw_rad, "high": limits.yaw_rad})


def refuse_unsuited(spec: Specification, robot: str, place: str, fix: str) -> None:
    """Raise InputError where candidates of this specification do not suit the robot."""
    limits, candidates = robot_limits(robot), spec.candidates
    for field, given, limit in (
        ("arm_reach_m", candidates.arm_reach_m, limits.reach_m),
        ("base_height_m", candidates.base_height_m, limits.base_height_m),
    ):
        if limit is not None and not limit[0] - _STEP_M <= given.low <= given.high <= limit[1] + _STEP_M:
            has = f"{limit[0]:g} to {limit[1]:g} m" if limit[0] < limit[1] else f"{limit[0]:g} m"
            problem = f"{given.low:g} to {given.high:g} m, and robot {robot} has {has}"
            raise InputError(place, f"candidates.{field}", problem, fix)
    own_m, footprint = limits.base_radius_m, footprint_of(candidates)
    if own_m is not None and candidates.base_radius_m < own_m - _STEP_M:
        problem = f"{candidates.base_radius_m:g} m, and the base of robot {robot} has {own_m:g} m"
        raise InputError(place, "candidates.base_radius_m", problem, fix)
    if own_m is not None and footprint is not None and not footprint.holds(limits.polygon_m, own_m, _STEP_M):
        raise InputError(place, "candidates.footprint_m", f"does not hold the base of robot {robot}", fix)
    turns, own_rad = candidates.yaw_rad or Turns(low=0.0, high=0.0), limits.yaw_rad
    if limits.presents == "side" and not turns.low - _SAME_RAD <= own_rad <= turns.high + _SAME_RAD:
        problem = f"is {turns.low:g} to {turns.high:g}, and robot {robot} stands at {own_rad:g} to the target"
        raise InputError(place, "candidates.yaw_rad", problem, fix)


def _narrowed(default: Range, limit: tuple[float, float]) -> dict[str, float]:
    """The intersection of default and limit, or the limit where it is empty."""
    low, high = max(default.low, limit[0]), min(default.high, limit[1])
    return {"low": low, "high": high} if low <= high else {"low": limit[0], "high": limit[1]}
