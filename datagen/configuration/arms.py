"""The arm of a specification: the robot of `plan` and `sim` labels, and the candidates that suit it."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pydantic import ValidationError

from datagen.schemas.errors import InputError, choices
from datagen.schemas.specification import ArmParams, CandidateParams, DisturbanceParams, Range, Specification
from datagen.workers.extras import how_to_get
from datagen.workers.robots import ROBOTS, robot_limits

# Label sources that move an arm, and the distributions whose version can change bits of their labels.
ARM_PACKAGES: dict[str, tuple[str, ...]] = {
    "plan": ("coal", "mani_skill", "pin", "sapien"),
    "sim": ("coal", "mani_skill", "pin", "sapien"),
}
# Sections of the arm that only some label sources have.
_NOT_FOR: dict[str, tuple[str, ...]] = {"plan": ("trial",), "sim": ()}
# Reaches are stated in whole millimetres.
_STEP_M = 0.001
# Step between sampled reaches: opening an arm of another reach costs as much as planning ten candidates.
REACH_STEP_M = 0.01

Fields = dict[str, Any]


def refuse_missing_packages(label_source: str) -> None:
    """Raise InputError where the label source needs libraries that are not installed."""
    for name in ARM_PACKAGES.get(label_source, ()):
        try:
            version(name)
        except PackageNotFoundError:
            raise InputError(
                "label source", label_source, f"needs {name}, not installed", how_to_get("sim")
            ) from None


def arm_versions(label_source: str) -> dict[str, str]:
    """Versions of the distributions that plan or simulate the arm of this label source."""
    return {name: version(name) for name in ARM_PACKAGES.get(label_source, ())}


def complete_arm(
    label_source: str, fields: Fields, robot: str | None, repeats: int | None, place: str
) -> None:
    """Fill in the section `arm` of a specification's fields for this label source.

    `robot` and `repeats` are the options --robot and --perturb, and override the section that came from
    `place`. Raises InputError for what the label source does not support.
    """
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
    if robot is not None:
        arm["robot"] = robot
    elif isinstance(named := arm.get("robot"), str) and named not in ROBOTS:
        raise InputError(place, "arm.robot", f"{named!r} is unknown", choices(ROBOTS, str(named)))
    if label_source == "sim":
        arm.setdefault("trial", {})
    if repeats is not None:
        disturbance = arm.setdefault("disturbance", {})
        if isinstance(disturbance, dict):
            disturbance["repeats"] = repeats


def robot_of(fields: Fields, robot: str | None) -> str | None:
    """The robot that candidates must suit: --robot, or that of the arm; None for any."""
    arm = fields.get("arm")
    if robot is not None or not isinstance(arm, dict):
        return robot
    named = arm.get("robot", ArmParams().robot)
    return named if isinstance(named, str) else None


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
    own_m = limits.base_radius_m
    if own_m is not None and candidates.base_radius_m < own_m - _STEP_M:
        problem = f"{candidates.base_radius_m:g} m, and the base of robot {robot} has {own_m:g} m"
        raise InputError(place, "candidates.base_radius_m", problem, fix)


def _narrowed(default: Range, limit: tuple[float, float]) -> dict[str, float]:
    """The intersection of default and limit, or the limit where it is empty."""
    low, high = max(default.low, limit[0]), min(default.high, limit[1])
    return {"low": low, "high": high} if low <= high else {"low": limit[0], "high": limit[1]}
