"""Plan and trials of one candidate, shared by the label sources `plan` and `sim`.

base clear -> within reach -> a grasp free of the scene -> arm, path, approach, lift   (`plan` ends here;
   with disturbances it plans again from `repeats` arrival poses near the candidate)
-> executed in physics once, or with disturbances from `repeats` arrival poses   (`sim`)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.identity import Stream, generator
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import ArmParams, DisturbanceParams, Specification
from datagen.workers.bases.candidates import SceneCandidates, footprint_of
from datagen.workers.bases.clearance import base_clearance_m
from datagen.workers.geometry.mesh import F64, transformed
from datagen.workers.geometry.transforms import inverse, translation, yaw_pose
from datagen.workers.grasps.grasp_cache import GraspSet, grasps_of
from datagen.workers.kinematics.tree import Bools
from datagen.workers.motion import MotionPlan, PlanReport
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.motion.planning_scene import PlanningScene, prepare
from datagen.workers.robots import open_robot
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from datagen.workers.trials import Disturbance, TrialResult
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.trial_scene import TrialScene, prepare_trials

_PROGRESS = tuple(OUTCOMES)  # failures in order of progress, after success


@dataclass(frozen=True, eq=False)
class CandidateTrial:
    """The results for one candidate."""

    outcome: str
    report: PlanReport | None = None  # planning at the candidate; None where no planning was needed
    plan: MotionPlan | None = None  # that of the report
    results: tuple[TrialResult, ...] = ()  # one for each execution
    T_world_base: tuple[F64, ...] = ()  # (4, 4) each, poses of the mount in them
    successes: int = 0
    trials: int = 0  # attempts of which `successes` succeeded: 1, or the disturbed repeats; 0 if none
    retry_outcome: str | None = None  # the last grasp executed after the first one failed


@dataclass(eq=False)
class ArmInScene:
    """One robot in one scene; data for planning and physics is prepared on first use."""

    scene: SettledScene
    robot: Robot
    grasps: GraspSet
    arm: ArmParams
    base_radius_m: float
    clock: StageClock = field(default_factory=StageClock)
    draw: int = 0  # seeds all random numbers of labels; benchmarks.repeatability compares others with 0

    @cached_property
    def planning(self) -> PlanningScene:
        with self.clock.stage("grasps"):
            return prepare(
                self.scene,
                self.robot,
                self.grasps,
                self.arm.motion,
                self.arm.grasps.per_scene,
                self.base_radius_m,
                self.draw,
            )

    @cached_property
    def trials(self) -> TrialScene:
        assert self.arm.trial is not None
        with self.clock.stage("execute"):
            return prepare_trials(self.scene, self.robot, self.arm.trial, self.base_radius_m)

    @cached_property
    def tcp_positions_m(self) -> F64:
        """World positions (G, 3) of the TCP at all grasps of the target."""
        return transformed(self.grasps.T_object_tcp[:, :3, 3], self.scene.T_world_object[0])

    def base_pose(self, candidates: SceneCandidates, row: int) -> F64:
        """World pose (4, 4) of the mount at candidate `row`."""
        (x, y), yaw_rad = candidates.base_xy_m[row].tolist(), float(candidates.base_yaw_rad[row])
        return yaw_pose(x, y, self.robot.base_height_m, yaw_rad)

    def path_generator(self, index: int, spec: Specification) -> np.random.Generator:
        other = (self.draw,) if self.draw else ()
        return generator(spec.seed, Stream.PATH, self.scene.index, self.scene.retry, index, *other)

    def is_within_reach(self, T_world_base: F64) -> bool:
        """Whether the arm is long enough for any grasp of the target, in a straight line."""
        shoulder_m = T_world_base[:3, :3] @ self.robot.shoulder_m + T_world_base[:3, 3]
        gaps_m = np.linalg.norm(self.tcp_positions_m - shoulder_m, axis=1)
        return bool((gaps_m <= self.robot.reach_m).any())


def arm_in_scene(
    scene: SettledScene,
    candidates: SceneCandidates,
    row: int,
    spec: Specification,
    clock: StageClock,
    draw: int = 0,
) -> ArmInScene:
    """The robot of candidate `row` in a scene. Raises InputError for an unknown robot or a wrong reach."""
    arm = arm_of(spec)
    with clock.stage("grasps"):
        reach_m, height_m = float(candidates.arm_reach_m[row]), float(candidates.base_height_m[row])
        robot = open_robot(arm.robot_key, reach_m, height_m)
        grasps = grasps_of(scene.models[0], robot.gripper, arm.grasps, draw)
    base_radius_m = float(spec.candidates.radius_of_base_m(candidates.arm_reach_m[row]))
    return ArmInScene(scene, robot, grasps, arm, base_radius_m, clock, draw)


def arm_of(spec: Specification) -> ArmParams:
    """The specification's arm section. Raises InputError where it has none."""
    if spec.arm is None:
        fix = "Submit plan or sim, which have an arm"
        raise InputError("specification", "arm", f"none for label source {spec.label_source}", fix)
    return spec.arm


def try_candidate(
    at: ArmInScene, candidates: SceneCandidates, row: int, spec: Specification, record: bool = False
) -> CandidateTrial:
    """Plan and, where the specification has trials, execute one candidate.

    Depends only on the scene, the candidate and the specification, not on earlier candidates.
    """
    if candidates.clearance_m[row] < 0:
        return CandidateTrial("base_collision")
    if len(at.grasps) == 0:
        return CandidateTrial("no_grasp")
    T_world_base = at.base_pose(candidates, row)
    if not at.is_within_reach(T_world_base):
        return CandidateTrial("out_of_reach")
    index = int(candidates.index[row])
    rng = at.path_generator(index, spec)
    planning, clock = at.planning, at.clock
    with clock.stage("plan"):
        report = plan_candidate(planning, T_world_base, rng)
    disturbances = disturbances_of(at, index, spec)
    arrived = [T_world_base @ d.T_base_moved for d in disturbances]
    fits = fits_at(at, arrived, candidates, row, spec) if arrived else np.empty(0, np.bool_)
    if at.arm.trial is not None and report.plan is None:
        return CandidateTrial(report.outcome, report)
    if disturbances:
        return _arrive(at, T_world_base, report, disturbances, fits, rng, record)
    if at.arm.trial is None or report.plan is None:
        has_plan = int(report.plan is not None)
        return CandidateTrial(report.outcome, report, report.plan, successes=has_plan, trials=1)
    return _attempt(at, T_world_base, report, report.plan, rng, record)


def _attempt(
    at: ArmInScene,
    T_world_base: F64,
    report: PlanReport,
    plan: MotionPlan,
    rng: np.random.Generator,
    record: bool,
) -> CandidateTrial:
    """Execute the plan; after a failure execute further grasps, each in a new scene, until one succeeds.

    The label is that of the first grasp: a robot that drops the target changes the scene.
    """
    trial = at.arm.trial
    assert trial is not None
    planning, trials, clock = at.planning, at.trials, at.clock
    undisturbed = Disturbance.none(trial.object_friction)
    results: list[TrialResult] = []
    failed: set[int] = set()
    executed: MotionPlan | None = plan
    while executed is not None:
        with clock.stage("execute"):
            results.append(run_trial(trials, T_world_base, executed, undisturbed, record))
        failed.add(executed.grasp)
        if results[-1].outcome == "success" or len(results) == trial.max_attempts:
            break
        with clock.stage("plan"):
            executed = plan_candidate(planning, T_world_base, rng, frozenset(failed)).plan
    outcome = results[0].outcome
    retry_outcome = results[-1].outcome if len(results) > 1 else None
    bases, successes = (T_world_base,) * len(results), int(outcome == "success")
    return CandidateTrial(outcome, report, plan, tuple(results), bases, successes, 1, retry_outcome)


def _arrive(
    at: ArmInScene,
    T_world_base: F64,
    report: PlanReport,
    disturbances: list[Disturbance],
    fits: Bools,
    rng: np.random.Generator,
    record: bool,
) -> CandidateTrial:
    """Plan, and where there are trials execute, from the arrival pose of each disturbance.

    The robot knows its arrival pose, but not the other disturbances. Where `fits` (K,) is false, its body
    collides. With trials the label is positive where at least half succeed. Without, it is that of the
    candidate, also of one without a plan: a robot that arrives near one may succeed.
    """
    planning, trials = at.planning, None if at.arm.trial is None else at.trials
    results: list[TrialResult] = []
    bases: list[F64] = []
    ends: list[str] = []
    for disturbance, does_fit in zip(disturbances, fits.tolist(), strict=True):
        T_arrived = T_world_base @ disturbance.T_base_moved
        if not does_fit:
            ends.append("base_collision")
            continue
        with at.clock.stage("plan"):
            found = plan_candidate(planning, T_arrived, rng)
        if found.plan is None or trials is None:
            ends.append(found.outcome)
            continue
        with at.clock.stage("execute"):
            unknown = replace(disturbance, T_base_moved=np.eye(4))
            results.append(run_trial(trials, T_arrived, found.plan, unknown, record))
        bases.append(T_arrived)
        ends.append(results[-1].outcome)
    successes, outcome = ends.count("success"), report.outcome
    if trials is not None and 2 * successes >= len(ends):
        outcome = "success"
    elif trials is not None:
        counts = Counter(end for end in ends if end != "success")
        outcome = max(counts, key=lambda name: (counts[name], _PROGRESS.index(name)))
    return CandidateTrial(outcome, report, report.plan, tuple(results), tuple(bases), successes, len(ends))


def fits_at(
    at: ArmInScene,
    T_arrived: Sequence[F64],
    candidates: SceneCandidates,
    row: int,
    spec: Specification,
) -> Bools:
    """Whether the body of candidate `row`'s robot fits (K,) with its mount at these world poses (4, 4)."""
    xy = np.array([T[:2, 3] for T in T_arrived], np.float32)
    yaw_rad = np.array([np.arctan2(T[1, 0], T[0, 0]) for T in T_arrived], np.float32)
    height_m, camera_m = (
        np.repeat(column[row], len(xy)) for column in (candidates.base_height_m, candidates.camera_height_m)
    )
    radius_m, mast_m = np.full(len(xy), at.base_radius_m), spec.candidates.mast_radius_m
    outline = mast_m, footprint_of(spec.candidates), yaw_rad
    return base_clearance_m(xy, height_m, camera_m, radius_m, at.scene.house.obstacles, *outline) >= 0


def disturbances_of(at: ArmInScene, index: int, spec: Specification) -> list[Disturbance]:
    """The disturbances of candidate `index` of its scene; empty where the specification has none."""
    if at.arm.disturbance is None:
        return []
    rng = generator(spec.seed, Stream.DISTURBANCE, at.scene.index, at.scene.retry, index)
    return draw_disturbances(at.arm.disturbance, at.scene.T_world_object[0], rng)


def draw_disturbances(
    params: DisturbanceParams, T_world_target: F64, rng: np.random.Generator
) -> list[Disturbance]:
    """`repeats` random disturbances of the planned world; target and base slide and turn in their planes."""
    centre = translation(*T_world_target[:3, 3])
    drawn: list[Disturbance] = []
    for _ in range(params.repeats):
        target, base = rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.0, 3)
        friction = rng.uniform(params.object_friction.low, params.object_friction.high)
        mass_scale = rng.uniform(params.mass_scale.low, params.mass_scale.high)
        # The target may lie on its side: it turns about the world's vertical, not about its own z.
        turned = _planar(target, params.target_position_std_m, params.target_yaw_std_rad)
        T_world_moved = centre @ turned @ inverse(centre) @ T_world_target
        drawn.append(
            Disturbance(
                inverse(T_world_target) @ T_world_moved,
                _planar(base, params.base_position_std_m, params.base_yaw_std_rad),
                float(friction),
                float(mass_scale),
            )
        )
    return drawn


def _planar(normal: F64, position_std_m: float, yaw_std_rad: float) -> F64:
    x_m, y_m = normal[:2] * position_std_m
    return yaw_pose(float(x_m), float(y_m), 0.0, float(normal[2] * yaw_std_rad))
