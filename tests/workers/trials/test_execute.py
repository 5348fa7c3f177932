"""Executed trials make physical sense: what holds, what slips, what blocks, and what is recorded."""

from __future__ import annotations

import dataclasses
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")

from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import translation, yaw_pose
from datagen.workers.motion import MotionPlan
from datagen.workers.robots import open_robot, robot_limits, robot_source
from datagen.workers.robots.resources import package_folders
from datagen.workers.robots.robot import Robot
from datagen.workers.robots.robot_file import RobotSource
from datagen.workers.scenes import SettledScene
from datagen.workers.trials import Disturbance, TrialResult
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.physics import TrialWorld
from datagen.workers.trials.trial_scene import prepare_trials
from tests.sim_extra import needs_robots
from tests.workers.trials.worlds import base_before, on_top_m, plan_from_above, scene_with
from tests.workers.worlds import TABLE_TOP_M, box_body, box_model

PARAMS = TrialParams()
UNMOVED = np.eye(4)
PHASES = ("reach", "approach", "close", "lift", "hold")


@cache
def arm() -> Robot:
    """Opened by the first test: to import this file takes no compiler."""
    return open_robot("panda-scaled", 0.8, 0.8)


@cache
def base() -> F64:
    return base_before(arm(), 0.5)


def box(mass_kg: float = 0.3) -> SettledScene:
    """A box on the table, one more beside it."""
    target, other = box_model("target", (0.05, 0.05, 0.12), mass_kg), box_model("other", (0.06, 0.06, 0.1))
    return scene_with([target, other], [(0.0, 0.0), (0.0, 0.25)])


def trial(
    scene: SettledScene,
    disturbance: Disturbance | None = None,
    params: TrialParams = PARAMS,
    plan: MotionPlan | None = None,
    record: bool = False,
) -> TrialResult:
    prepared = prepare_trials(scene, arm(), params, 0.1)
    plan = plan or plan_from_above(arm(), base(), on_top_m(scene, 0.03), 0.07)
    return run_trial(prepared, base(), plan, disturbance or Disturbance.none(params.object_friction), record)


def moved(T_target: F64 = UNMOVED, T_base: F64 = UNMOVED) -> Disturbance:
    return Disturbance(T_target, T_base, 0.6, 1.0)


def test_a_box_is_lifted_and_held_and_the_recording_tells_the_phases_in_order() -> None:
    result = trial(box(), record=True)
    recording = result.recording
    assert result.outcome == "success" and recording is not None
    assert result.lift_m == pytest.approx(0.1, abs=0.005)
    assert result.slip_m < 0.003
    assert result.disturbed_m == 0.0
    T_world_tcp = base() @ arm().T_base_tcp(recording.q_rad[-1])
    top_m = recording.T_world_object[-1, 0, :3, 3] + [0.0, 0.0, 0.06 - 0.03]
    assert np.linalg.norm(T_world_tcp[:3, 3] - top_m) < 0.005
    assert (np.diff(recording.time_s) > 0).all()
    order = [PHASES.index(phase) for phase in recording.phase]
    assert order == sorted(order) and set(order) == set(range(5))
    n = len(recording.time_s)
    assert recording.q_rad.shape == (n, 7) and recording.opening_m.shape == (n,)
    assert recording.T_world_object.shape == (n, 2, 4, 4)
    assert recording.opening_m[0] == pytest.approx(0.07, abs=1e-3)
    assert recording.opening_m[-1] == pytest.approx(0.05, abs=2e-3)
    np.testing.assert_array_equal(recording.T_world_object[0], box().T_world_object.astype(np.float32))


@pytest.mark.parametrize(
    ("mass_kg", "disturbance", "outcome"),
    [
        # Two pads of 40 N hold 25 N at 0.05 (0.32 with rubber of 2.0) and 88 N at 0.6 (1.1): 3 kg are 29 N.
        (3.0, Disturbance.none(0.05), "slipped"),
        (3.0, Disturbance.none(0.6), "success"),
        (0.3, moved(T_target=translation(0.0, 0.12, 0.0)), "missed"),
        (0.3, moved(T_base=translation(0.0, -0.15, 0.0)), "missed"),  # the hand is taken along
        (0.3, moved(T_base=yaw_pose(0.01, 0.0, 0.0, 0.01)), "success"),
    ],
)
def test_friction_and_places_that_were_moved_decide(
    mass_kg: float, disturbance: Disturbance, outcome: str
) -> None:
    assert trial(box(mass_kg), disturbance).outcome == outcome


def test_an_object_too_heavy_for_the_arm_is_held_and_not_lifted() -> None:
    """9 kg that the pads hold: the drives give way, and the target rises by less than four fifths."""
    scene, sticky = box(mass_kg=9.0), Disturbance.none(5.0)
    result = trial(scene, sticky)
    assert result.outcome == "slipped" and result.slip_m < 0.003
    assert 0.05 < result.lift_m < 0.08
    assert trial(box(mass_kg=4.0), sticky).outcome == "success"


def lifted_by_its_end(length_m: float, mass_kg: float, dx_m: float) -> TrialResult:
    """A bar grasped 2 cm from its end."""
    scene = scene_with([box_model("bar", (length_m, 0.04, 0.04), mass_kg)], [(dx_m, 0.0)])
    end_m = on_top_m(scene, 0.02) + [0.02 - length_m / 2, 0.0, 0.0]
    plan = plan_from_above(arm(), base(), end_m, 0.07)
    return trial(scene, Disturbance.none(0.3), plan=plan, record=True)


def test_a_bar_that_tilts_is_lifted_unless_its_far_end_stays_on_the_table() -> None:
    """It tilts by its weight: its middle rises less than the point between the pads."""
    result = lifted_by_its_end(0.3, 1.0, 0.0)
    assert result.recording is not None
    origin_rise_m = np.ptp(result.recording.T_world_object[[0, -1], 0, 2, 3])
    assert result.lift_m > origin_rise_m + 0.01
    assert result.slip_m < 0.01
    assert lifted_by_its_end(0.6, 1.5, 0.1).outcome == "slipped"


@pytest.mark.parametrize(("speed_mps", "outcome"), [(3.0, "unstable"), (1.0, "success")])
def test_a_thrown_object_makes_the_trial_unstable(
    monkeypatch: pytest.MonkeyPatch, speed_mps: float, outcome: str
) -> None:
    """3 m/s carry 46 cm up, more than a hand that rises by 10 cm can have given; 1 m/s carries 5 cm up."""
    drive = TrialWorld.drive

    def kicking(self: TrialWorld, steps: int, start: F64, end: F64, first: int = 0) -> None:
        other = self._things[1]
        if not hasattr(self, "kicked"):
            self.kicked = True
            other.wake_up()
            other.set_linear_velocity([0.0, 0.0, speed_mps])
        drive(self, steps, start, end, first)

    monkeypatch.setattr(TrialWorld, "drive", kicking)
    assert trial(box()).outcome == outcome


def test_whole_simulation_comes_to_the_same_end() -> None:
    scene = box()
    plan = plan_from_above(arm(), base(), on_top_m(scene, 0.03), 0.07)
    prepared = prepare_trials(scene, arm(), PARAMS, 0.1)
    short, whole = (
        run_trial(prepared, base(), plan, Disturbance.none(0.6), record=True, whole=whole)
        for whole in (False, True)
    )
    assert short.outcome == whole.outcome == "success"
    assert short.lift_m == pytest.approx(whole.lift_m, abs=1e-3)
    assert short.simulated_s < whole.simulated_s  # holding ends once the target rests
    assert short.recording is not None and whole.recording is not None
    reach = [phase == "reach" for phase in short.recording.phase]
    np.testing.assert_allclose(
        short.recording.q_rad[: len(reach)][reach], whole.recording.q_rad[: len(reach)][reach], atol=0.02
    )


def test_slip_is_bounded_as_asked() -> None:
    result = trial(box(), params=PARAMS.model_copy(update={"max_slip_m": 1e-6}))
    assert result.outcome == "slipped" and 1e-6 < result.slip_m < 0.003


def test_a_hand_that_lands_on_the_target_has_not_reached_its_grasp() -> None:
    """5 cm below its top: the palm stands on it 2 cm too high, with each joint nearly where it should be."""
    scene = box()
    plan = plan_from_above(arm(), base(), on_top_m(scene, 0.05), 0.07)
    assert trial(scene, plan=plan).outcome == "not_reached"


def test_a_target_moved_into_the_table_starts_on_it() -> None:
    result = trial(box(), moved(T_target=translation(0.0, 0.0, -0.03)), record=True)
    assert result.recording is not None
    assert result.recording.T_world_object[0, 0, 2, 3] == pytest.approx(TABLE_TOP_M + 0.0605, abs=1e-4)
    assert result.outcome == "success"


def test_an_arm_that_meets_a_wall_does_not_arrive() -> None:
    (x, y, _), half = box().target_center_m, 0.02
    board = box_body("board|1", "furniture", "Board", (half, 0.6, 1.0), (x - 0.2, y, TABLE_TOP_M + 0.5))
    scene = scene_with(box().models, [(0.0, 0.0), (0.0, 0.25)], [board])
    result = trial(scene)
    assert result.outcome == "not_reached"
    assert result.simulated_s < 3.0


def test_a_pushed_object_is_measured() -> None:
    models = [box_model("target", (0.05, 0.05, 0.12)), box_model("tall", (0.04, 0.04, 0.3))]
    scene = scene_with(models, [(0.0, 0.0), (0.0, 0.07)])
    assert trial(scene).disturbed_m > 0.02


@pytest.mark.parametrize("place", ["T_target_moved", "T_base_moved"])
def test_poses_that_are_no_poses_are_unstable_and_no_exception(place: str) -> None:
    broken = np.eye(4)
    broken[0, 3] = np.nan
    result = trial(box(), dataclasses.replace(moved(), **{place: broken}))
    assert result.outcome == "unstable"
    assert np.isfinite([result.lift_m, result.slip_m, result.disturbed_m, result.simulated_s]).all()


@pytest.mark.parametrize(
    ("name", "reach_m", "distance_m"),
    [
        ("panda", None, 0.4),
        ("xarm7", None, 0.4),
        ("fetch", None, 0.5),
        ("panda-scaled", 0.45, 0.2),
        pytest.param("ur5", None, 0.45, marks=needs_robots),
        pytest.param("tiago-pro", None, 0.4, marks=needs_robots),
        pytest.param("pr2", None, 0.4, marks=needs_robots),
        pytest.param("stretch3", None, 0.4, marks=needs_robots),
    ],
)
def test_every_robot_lifts_a_box(name: str, reach_m: float | None, distance_m: float) -> None:
    robot = open_robot(name, reach_m, (robot_limits(name).base_height_m or (0.8,))[0])
    scene = scene_with([box_model("target", (0.05, 0.05, 0.12))], [(-0.45, 0.0)])
    base = base_before(robot, 0.45 + distance_m)
    plan = plan_from_above(robot, base, on_top_m(scene, 0.03), 0.08)
    # From the pregrasp on: the straight way there from a tucked pose may lead through the table.
    plan = dataclasses.replace(plan, q_reach_rad=plan.q_approach_rad[[0, 0]])
    result = run_trial(prepare_trials(scene, robot, PARAMS, 0.1), base, plan, Disturbance.none(0.6))
    assert (result.outcome, result.lift_m) == ("success", pytest.approx(0.1, abs=0.005))


def test_a_robot_whose_urdf_has_no_masses_lifts_a_box_as_one_with_masses(tmp_path: Path) -> None:
    folder = next(package_folders("mani_skill")) / "assets/robots/panda"
    (tmp_path / "franka_description").symlink_to(folder / "franka_description")
    text = re.sub(r"<inertial>.*?</inertial>", "", (folder / "panda_v2.urdf").read_text(), flags=re.DOTALL)
    (tmp_path / "panda.urdf").write_text(text)
    keys = robot_source("panda").keys.model_copy(update={"urdf": str(tmp_path / "panda.urdf")})
    robot = Robot(RobotSource(tmp_path / "robot.toml", keys)).at_height(0.8)
    base = base_before(robot, 0.4)
    plan = plan_from_above(robot, base, on_top_m(box(), 0.03), 0.07)
    result = run_trial(prepare_trials(box(), robot, PARAMS, 0.1), base, plan, Disturbance.none(0.6))
    assert (result.outcome, result.lift_m) == ("success", pytest.approx(0.1, abs=0.005))
