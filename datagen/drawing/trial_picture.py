"""One candidate's trial, run again with its poses recorded and drawn: `datagen show --trial`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.display.styles import OUTCOME_STYLES
from datagen.drawing.arm_picture import best_success
from datagen.drawing.film import Film, Moments, filmstrip_moments
from datagen.drawing.filmstrip import (
    MOTION_NEAR_PX,
    MOTION_WIDE_PX,
    SHEET_NEAR_PX,
    SHEET_WIDE_PX,
    Title,
    write_motion,
    write_sheet,
)
from datagen.drawing.posed_robot import robot_bodies
from datagen.drawing.scene_picture import Lines, Shown
from datagen.schemas.cost import StageClock
from datagen.schemas.errors import InputError
from datagen.schemas.outcomes import OUTCOMES
from datagen.schemas.specification import Specification
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.labels.arm_labelling import (
    ArmInScene,
    CandidateTrial,
    arm_in_scene,
    arm_of,
    try_candidate,
)
from datagen.workers.motion import MotionPlan
from datagen.workers.motion.arm_collision import surroundings
from datagen.workers.motion.rrt_connect import dense
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from datagen.workers.scenes.reconstruct import reconstruct_candidates
from datagen.workers.trials import Recording, TrialResult

_STEP_S = 0.05  # between the moments of a plan that was not executed
_STEP_RAD = 0.08  # advance of a plan in that time, over all joints
_TRIES = 7  # poses to show of an arm without a plan


def draw_trial(shown: Shown, candidate: int | None, out: Path) -> Lines:
    """Draw a candidate's trial as a filmstrip, or an animation where `out` is a .gif; None: the best success.

    Raises InputError where there is no such candidate, no success, or no motion to animate.
    """
    arm = arm_of(shown.spec)
    row = _candidate(shown, candidate)
    retrial = try_again(
        shown.recalled, reconstruct_candidates(shown.samples, shown.recalled), row, shown.spec
    )
    outcome, robot = retrial.trial.outcome, retrial.robot
    moving = out.suffix.lower() == ".gif"
    if moving and not retrial.moves:
        problem = f"candidate {row} ended as {outcome} before the arm moved: there is nothing to animate"
        raise InputError(out, "--out", problem, "Give a name that ends in .png")
    stored = tuple(OUTCOMES)[int(shown.samples["outcome"][row])]
    title = Title(
        OUTCOME_STYLES[outcome].colour,
        f"candidate {row}: {outcome} ({_words(retrial)})",
        (
            shown.title,
            f"{arm.robot}, reach {robot.reach_m:.2f} m, mount {robot.base_height_m:.2f} m high"
            f"   {_measured(retrial)}" + (f"   stored as {stored}" if stored != outcome else ""),
        ),
    )
    sizes = (MOTION_WIDE_PX, MOTION_NEAR_PX) if moving else (SHEET_WIDE_PX, SHEET_NEAR_PX)
    bodies = robot_bodies(robot, float(shown.spec.candidates.radius_of_base_m(robot.reach_m)))
    film = Film(shown.recalled, bodies, retrial.T_world_base, retrial.recording, retrial.moments, *sizes)
    (write_motion if moving else write_sheet)(film, title, out)
    return [
        ("candidate", f"{row} at {shown.position_text(row)}"),
        ("outcome", outcome),
        ("measured", _measured(retrial)),
    ]


def _candidate(shown: Shown, candidate: int | None) -> int:
    samples, scene = shown.samples, shown.recalled.index
    count = len(samples["label"])
    if candidate is None:
        best = best_success(samples)
        if best is None:
            problem = f"no candidate of scene {scene} succeeded"
            raise InputError(
                shown.run, "--trial", problem, f"Give one from 0 to {count - 1} to see why it failed"
            )
        return best
    if not 0 <= candidate < count:
        problem = f"{candidate} is not a candidate of scene {scene}"
        raise InputError(shown.run, "--trial", problem, f"Give one from 0 to {count - 1}")
    return candidate


def _words(retrial: Retrial) -> str:
    if retrial.trial.outcome != "success":
        return OUTCOME_STYLES[retrial.trial.outcome].words
    return "a whole plan" if retrial.result is None else "lifted and held"


def _measured(retrial: Retrial) -> str:
    trial, result = retrial.trial, retrial.result
    if result is None:
        return "planned, not executed" if trial.plan is not None else "no plan, nothing executed"
    numbers = (
        f"lift {100 * result.lift_m:.1f} cm, slip {100 * result.slip_m:.1f} cm, "
        f"others moved {100 * result.disturbed_m:.1f} cm"
    )
    if retrial.shown is None or len(trial.results) == 1:
        return numbers
    return f"{numbers}, execution {retrial.shown + 1} of {len(trial.results)}"


@dataclass(frozen=True, eq=False)
class Retrial:
    """The repeated trial of a candidate. `recording` holds a trial, a plan, or tried poses."""

    robot: Robot
    T_world_base: F64  # (4, 4), true pose of the mount
    trial: CandidateTrial
    shown: int | None  # recorded row of `trial.results`; None where nothing was executed
    recording: Recording
    moments: Moments  # to show

    @property
    def moves(self) -> bool:
        """Whether the recording is a motion; else it holds poses that were tried."""
        return bool(self.recording.time_s[-1] > self.recording.time_s[0])

    @property
    def result(self) -> TrialResult | None:
        """The execution to show."""
        return None if self.shown is None else self.trial.results[self.shown]


def try_again(scene: SettledScene, candidates: SceneCandidates, row: int, spec: Specification) -> Retrial:
    """Plan, and for `sim` execute, candidate `row` again; the first execution with its outcome is shown."""
    at = arm_in_scene(scene, candidates, row, spec, StageClock())
    trial = try_candidate(at, candidates, row, spec, record=True)
    T_world_base = at.base_pose(candidates, row)
    alike = [k for k, result in enumerate(trial.results) if result.outcome == trial.outcome]
    shown = alike[0] if alike else None
    recording = None if shown is None else trial.results[shown].recording
    if shown is not None and recording is not None:
        T_world_base = trial.T_world_base[shown]
        kept = _finite_part(recording)
        return Retrial(at.robot, T_world_base, trial, shown, kept, filmstrip_moments(kept))
    if trial.plan is not None:
        planned = planned_motion(at.robot, trial.plan, T_world_base, scene.T_world_object)
        return Retrial(at.robot, T_world_base, trial, None, planned, filmstrip_moments(planned))
    poses, moments = _tried_poses(at, trial, T_world_base)
    return Retrial(at.robot, T_world_base, trial, None, poses, moments)


def planned_motion(robot: Robot, plan: MotionPlan, T_world_base: F64, T_world_object: F64) -> Recording:
    """A plan as if executed perfectly: the target moves with the hand once it is grasped."""
    q, phases = [plan.q_reach_rad[:1]], ["reach"]
    for phase, path in (
        ("reach", plan.q_reach_rad),
        ("approach", plan.q_approach_rad),
        ("lift", plan.q_lift_rad),
    ):
        q.append(dense(path, _STEP_RAD)[1:])
        phases += [phase] * len(q[-1])
    q_rad = np.concatenate(q)
    poses = np.tile(T_world_object, (len(q_rad), 1, 1, 1))
    T_tcp_target = inverse(T_world_base @ robot.T_base_tcp(plan.q_approach_rad[-1])) @ T_world_object[0]
    for k, phase in enumerate(phases):
        if phase == "lift":
            poses[k, 0] = T_world_base @ robot.T_base_tcp(q_rad[k]) @ T_tcp_target
    opening_m = np.full(len(q_rad), plan.opening_m)
    return Recording(
        np.arange(len(q_rad), dtype=np.float64) * _STEP_S, q_rad, opening_m, poses, tuple(phases)
    )


def _tried_poses(at: ArmInScene, trial: CandidateTrial, T_world_base: F64) -> tuple[Recording, Moments]:
    """The tucked arm and, where planning failed later, the arm at grasps with an IK solution."""
    robot = at.robot
    q_rad, opening_m, words = [robot.homes_rad[0]], [robot.gripper.max_opening_m], ["tucked"]
    if trial.report is not None:
        planning = at.planning
        around = surroundings(planning, T_world_base)
        kept = planning.around.kept
        T_base_tcp = np.matmul(inverse(T_world_base), planning.around.T_world_tcp[kept])
        table = planning.moving.table
        distance, seeds = table.distance(T_base_tcp), table.seeds(T_base_tcp, planning.params.ik_seeds)
        for k in np.argsort(distance, kind="stable").tolist():
            found = (robot.ik(T_base_tcp[k], seed) for seed in seeds[k])
            q = next((q for q in found if q is not None), None)
            if q is None:
                continue
            blocked = around.is_base_stuck or around.first_arm_blocked(q[None], is_target_held=False) == 0
            q_rad.append(q)
            opening_m.append(float(planning.around.opening_m[kept[k]]))
            words.append("the arm collides here" if blocked else "the arm is free here")
            if len(words) > _TRIES:
                break
    n = len(words)
    poses = np.tile(at.scene.T_world_object, (n, 1, 1, 1))
    recording = Recording(np.zeros(n), np.stack(q_rad), np.array(opening_m), poses, ("reach",) * n)
    return recording, tuple(enumerate(words))


def _finite_part(recording: Recording) -> Recording:
    """The part of the recording with finite numbers; unstable physics cannot be drawn."""
    finite = np.isfinite(recording.q_rad).all(1) & np.isfinite(recording.T_world_object).all((1, 2, 3))
    n = int(np.argmin(np.append(finite, False)))
    return Recording(
        recording.time_s[:n],
        recording.q_rad[:n],
        recording.opening_m[:n],
        recording.T_world_object[:n],
        recording.phase[:n],
    )
