"""One candidate's trial, run again with its poses recorded and drawn: `datagen show --trial`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from datagen.display.styles import OUTCOME_STYLES
from datagen.drawing.film import Film, filmstrip_moments, write_animation, write_sheet
from datagen.drawing.posed_robot import robot_bodies
from datagen.drawing.scene_picture import Lines, Shown, best_success
from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import Specification
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.labels.arm_labelling import CandidateTrial, arm_in_scene, try_candidate
from datagen.workers.motion import MotionPlan
from datagen.workers.motion.path_search import dense
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_candidates
from datagen.workers.trials import Recording, TrialResult

_STEP_S = 0.05  # between the moments of a plan that was not executed
_STEP_RAD = 0.08  # advance of a plan in that time, over all joints


@dataclass(frozen=True, eq=False)
class Retrial:
    """The repeated trial of a candidate. `recording` holds an execution, a plan, or the tucked arm."""

    robot: Robot
    T_world_base: F64  # (4, 4), true pose of the mount
    trial: CandidateTrial
    result: TrialResult | None  # the execution to show
    recording: Recording

    def film(self, scene: ReconstructedScene, spec: Specification) -> Film:
        """The trial to be drawn in its scene."""
        bodies = robot_bodies(self.robot, float(spec.candidates.radius_of_base_m(self.robot.reach_m)))
        return Film(scene, bodies, self.T_world_base, self.recording, filmstrip_moments(self.recording))


def draw_trial(shown: Shown, candidate: int | None, out: Path) -> Lines:
    """Draw a candidate's trial as a filmstrip, or an animation where `out` is a .gif; None: the best success.

    Raises InputError where there is no such candidate, no success, or no motion to animate.
    """
    row = _candidate(shown, candidate)
    candidates = reconstruct_candidates(shown.samples, shown.recalled)
    again = try_again(shown.recalled, candidates, row, shown.spec)
    outcome, robot = again.trial.outcome, again.robot
    film = again.film(shown.recalled, shown.spec)
    moving = out.suffix.lower() == ".gif"
    if moving and not film.moves:
        problem = f"candidate {row} ended as {outcome} before the arm moved: there is nothing to animate"
        raise InputError(out, "--out", problem, "Give a name that ends in .png")
    words = OUTCOME_STYLES[outcome].words
    if outcome == "success":
        words = "a whole plan" if again.result is None else "lifted and held"
    stored = tuple(OUTCOMES)[int(shown.samples["outcome"][row])]
    facts = f"{robot.name}, reach {robot.reach_m:.2f} m, mount {robot.base_height_m:.2f} m high"
    changed = f"   stored as {stored}" if stored != outcome else ""
    title = (f"candidate {row}: {outcome} ({words})", shown.title, facts, _measured(again) + changed)
    (write_animation if moving else write_sheet)(film, OUTCOME_STYLES[outcome].colour, title, out)
    where = f"{row} at {shown.position_text(row)}"
    return [("candidate", where), ("outcome", outcome), ("measured", _measured(again))]


def _candidate(shown: Shown, candidate: int | None) -> int:
    scene, last = shown.recalled.index, len(shown.samples["label"]) - 1
    if candidate is None and (best := best_success(shown.samples)) is not None:
        return best
    if candidate is None or not 0 <= candidate <= last:
        problem = f"{candidate} is not a candidate of scene {scene}"
        problem = f"no candidate of scene {scene} succeeded" if candidate is None else problem
        raise InputError(shown.run, "--trial", problem, f"Give one from 0 to {last} to see why it failed")
    return candidate


def _measured(again: Retrial) -> str:
    result = again.result
    if result is None:
        return "planned, not executed" if again.trial.plan is not None else "no plan, nothing executed"
    lift_cm, slip_cm, others_cm = (100 * v for v in (result.lift_m, result.slip_m, result.disturbed_m))
    return f"lift {lift_cm:.1f} cm, slip {slip_cm:.1f} cm, others moved {others_cm:.1f} cm"


def try_again(scene: SettledScene, candidates: SceneCandidates, row: int, spec: Specification) -> Retrial:
    """Plan, and for `sim` execute, candidate `row` again; the first execution with its outcome is shown."""
    at = arm_in_scene(scene, candidates, row, spec, StageClock())
    trial = try_candidate(at, candidates, row, spec, record=True)
    T_world_base = at.base_pose(candidates, row)
    for result, T_executed in zip(trial.results, trial.T_world_base, strict=True):
        if result.outcome == trial.outcome and result.recording is not None:
            return Retrial(at.robot, T_executed, trial, result, _finite_part(result.recording))
    if trial.plan is not None:
        planned = planned_motion(at.robot, trial.plan, T_world_base, scene.T_world_object)
        return Retrial(at.robot, T_world_base, trial, None, planned)
    opening_m = np.array([at.robot.gripper.max_opening_m])
    tucked = Recording(
        np.zeros(1), at.robot.homes_rad[:1], opening_m, scene.T_world_object[None], ("tucked",)
    )
    return Retrial(at.robot, T_world_base, trial, None, tucked)


def planned_motion(robot: Robot, plan: MotionPlan, T_world_base: F64, T_world_object: F64) -> Recording:
    """A plan as if executed perfectly: the target moves with the hand once it is grasped."""
    q, phases = [plan.q_reach_rad[:1]], ["reach"]
    paths = {"reach": plan.q_reach_rad, "approach": plan.q_approach_rad, "lift": plan.q_lift_rad}
    for phase, path in paths.items():
        q.append(dense(np.ones(path.shape[1]), path, _STEP_RAD)[1:])
        phases += [phase] * len(q[-1])
    q_rad = np.concatenate(q)
    poses = np.tile(T_world_object, (len(q_rad), 1, 1, 1))
    T_tcp_target = inverse(T_world_base @ robot.T_base_tcp(plan.q_approach_rad[-1])) @ T_world_object[0]
    for k, phase in enumerate(phases):
        if phase == "lift":
            poses[k, 0] = T_world_base @ robot.T_base_tcp(q_rad[k]) @ T_tcp_target
    opening_m = np.full(len(q_rad), plan.opening_m)
    time_s = np.arange(len(q_rad), dtype=np.float64) * _STEP_S
    return Recording(time_s, q_rad, opening_m, poses, tuple(phases))


def _finite_part(recording: Recording) -> Recording:
    """The part of the recording with finite numbers; unstable physics cannot be drawn."""
    finite = np.isfinite(recording.q_rad).all(1) & np.isfinite(recording.T_world_object).all((1, 2, 3))
    n = int(np.argmin(np.append(finite, False)))
    return Recording(*(getattr(recording, field.name)[:n] for field in fields(recording)))
