"""The arm of a specification: filled in as the label source has it, and held against the robot's limits."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from datagen import cli
from datagen.configuration import specify as arms
from datagen.configuration.robot_fields import (
    REACH_STEP_M,
    complete_arm,
    narrow_candidates,
    refuse_missing_packages,
    refuse_unsuited,
    robot_of,
)
from datagen.schemas.errors import InputError
from datagen.schemas.specification import (
    ArmParams,
    CandidateParams,
    DisturbanceParams,
    MotionParams,
    Specification,
    TrialParams,
)
from datagen.workers.robots import ROBOTS, robot_limits
from tests.sim_extra import named_robots

SOURCES = {"houses": {"kind": "a", "digest": "1" * 64}, "objects": {"kind": "b", "digest": "2" * 64}}


def completed(
    source: str, fields: dict[str, Any] | None = None, robot: str | None = None, repeats: int | None = None
) -> ArmParams | None:
    fields = copy.deepcopy(fields or {})
    complete_arm(source, fields, robot, repeats, "run.toml")
    return Specification.model_validate(SOURCES | fields).arm


def test_each_label_source_gets_the_sections_it_has() -> None:
    near, disturbed = MotionParams(nearby_rounds=3), DisturbanceParams(repeats=3)
    assert completed("heuristic") is None
    assert completed("plan") == ArmParams(motion=near)
    assert completed("plan", {"arm": {"motion": {"nearby_rounds": 0}}}) == ArmParams(
        motion=MotionParams(nearby_rounds=0)
    )
    assert completed("plan", repeats=3) == ArmParams(motion=near, disturbance=disturbed)
    assert completed("sim") == ArmParams(motion=near, trial=TrialParams())
    assert completed("sim", repeats=3) == ArmParams(motion=near, trial=TrialParams(), disturbance=disturbed)


def test_the_option_wins_over_the_file_and_the_file_over_the_default() -> None:
    file = {"arm": {"robot": "panda", "motion": {"ik_seeds": 7}, "disturbance": {"base_yaw_std_rad": 0.1}}}
    arm = completed("sim", file, robot="panda-scaled", repeats=2)
    assert arm is not None and arm.disturbance is not None
    assert (arm.robot, arm.motion.ik_seeds) == ("panda-scaled", 7)
    assert (arm.disturbance.repeats, arm.disturbance.base_yaw_std_rad) == (2, 0.1)
    kept = completed("sim", file)
    assert kept is not None and kept.robot == "panda"


@pytest.mark.parametrize(
    ("source", "fields", "repeats", "words"),
    [
        ("heuristic", {"arm": {}}, None, ["run.toml", "arm", "heuristic has no arm"]),
        ("plan", {"arm": {"trial": {}}}, None, ["run.toml", "arm.trial", "submit sim"]),
        ("heuristic", {}, 3, ["--perturb", "heuristic"]),
        ("sim", {}, 0, ["--perturb: 0:", "greater than or equal to 1"]),
        ("sim", {}, -1, ["--perturb: -1:", "greater than or equal to 1"]),
        ("sim", {}, 1001, ["--perturb: 1001:", "less than or equal to 1000"]),
        ("plan", {"arm": {"robot": "hal"}}, None, ["run.toml: arm.robot:", "hal", "panda-scaled"]),
    ],
)
def test_contradictions_are_refused(
    source: str, fields: dict[str, Any], repeats: int | None, words: list[str]
) -> None:
    with pytest.raises(InputError) as error:
        complete_arm(source, fields, None, repeats, "run.toml")
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    ("source", "repeats", "draws", "words"),
    [
        ("heuristic", None, 3, ["--draws: 3:", "submit plan"]),
        ("sim", None, 3, ["--draws: 3:", "submit plan"]),
        ("plan", 2, 3, ["--draws: 3:", "--perturb"]),
        ("plan", None, 1, ["--draws: 1:", "2 to 100"]),
        ("plan", None, 101, ["--draws: 101:", "2 to 100"]),
    ],
)
def test_draws_that_nothing_makes_are_refused(
    source: str, repeats: int | None, draws: int, words: list[str]
) -> None:
    with pytest.raises(InputError) as error:
        complete_arm(source, {}, None, repeats, "run.toml", draws)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_the_robot_is_that_of_the_option_or_of_the_arm() -> None:
    assert robot_of({}, None) is None
    assert robot_of({}, "panda") == "panda"
    assert robot_of({"arm": {}}, None) == ArmParams().robot
    assert robot_of({"arm": {"robot": "fetch"}}, None) == "fetch"
    assert robot_of({"arm": {"robot": "fetch"}}, "panda") == "panda"


@pytest.mark.parametrize("robot", named_robots())
def test_narrowed_candidates_suit_the_robot(robot: str) -> None:
    fields: dict[str, Any] = {}
    narrow_candidates(fields, robot)
    spec = Specification.model_validate(SOURCES | fields)
    refuse_unsuited(spec, robot, "options", "")
    limits, defaults = robot_limits(robot), CandidateParams()
    assert limits.reach_m[0] <= spec.candidates.arm_reach_m.low <= spec.candidates.arm_reach_m.high
    if limits.base_height_m is None:
        assert spec.candidates.base_height_m == defaults.base_height_m
    if limits.base_radius_m is not None:
        assert spec.candidates.base_radius_m == limits.base_radius_m
    # A base that turns in place sweeps its circle.
    assert spec.candidates.footprint_m == (None if limits.presents == "turns" else limits.footprint_m)
    assert spec.candidates.yaw_rad is None


def test_the_scaled_family_leaves_the_papers_ranges_alone() -> None:
    fields: dict[str, Any] = {}
    narrow_candidates(fields, "panda-scaled")
    narrowed = Specification.model_validate(SOURCES | fields).candidates
    assert narrowed == CandidateParams(arm_reach_step_m=REACH_STEP_M)


@pytest.mark.parametrize(
    ("robot", "candidates", "field"),
    [
        ("panda-scaled", {"arm_reach_m": {"low": 0.2, "high": 0.5}}, "arm_reach_m"),
        ("panda-scaled", {"arm_reach_m": {"low": 0.5, "high": 1.1}}, "arm_reach_m"),
        ("panda", {"arm_reach_m": {"low": 0.7, "high": 0.947}}, "arm_reach_m"),
        ("fetch", {"base_radius_m": 0.1}, "base_radius_m"),
        ("fetch", {"footprint_m": [[0.2, 0.2], [-0.3, 0.3], [-0.3, -0.3], [0.2, -0.2]]}, "footprint_m"),
    ],
)
def test_what_a_file_sets_stays_and_is_refused_where_the_robot_has_it_not(
    robot: str, candidates: dict[str, Any], field: str
) -> None:
    fields: dict[str, Any] = {"candidates": copy.deepcopy(candidates)}
    narrow_candidates(fields, robot)
    assert fields["candidates"][field] == candidates[field]
    spec = Specification.model_validate(SOURCES | fields)
    with pytest.raises(InputError, match=f"candidates.{field}: .*{robot}"):
        refuse_unsuited(spec, robot, "run.toml", "Correct it")


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_missing_packages("heuristic")
    monkeypatch.setitem(arms.ARM_PACKAGES, "plan", ("numpy", "no-such-planner"))
    with pytest.raises(InputError, match=r"no-such-planner.*Install the extra sim: pip install"):
        refuse_missing_packages("plan")


def test_the_help_of_submit_names_every_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["submit", "--help"]) == 0
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert all(name in told for name in ROBOTS)
