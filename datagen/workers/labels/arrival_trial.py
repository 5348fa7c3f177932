"""One arrival of a closed loop: a robot plans and executes from the pose near a candidate that it reached."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.schemas.specification import DisturbanceParams, Specification, TrialParams
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.labels.arm_labelling import ArmInScene, arm_of, fits_at
from datagen.workers.motion.plan_candidate import plan_candidate
from datagen.workers.trials import Disturbance
from datagen.workers.trials.execute import run_trial

Offset = tuple[float, float, float]  # x ahead (m), y to the left (m), yaw (rad), in the frame of the goal


def arrival_specification(spec: Specification, executes: bool) -> Specification:
    """The specification of a run's arrivals: where it `executes`, with trials and disturbances.

    Sections that the run has are kept. Raises InputError where the run has no arm.
    """
    arm = arm_of(spec)
    trial = (arm.trial or TrialParams()) if executes else None
    disturbance = (arm.disturbance or DisturbanceParams()) if executes else None
    return spec.model_copy(
        update={"arm": arm.model_copy(update={"trial": trial, "disturbance": disturbance, "draws": None})}
    )


def try_arrival(
    at: ArmInScene,
    candidates: SceneCandidates,
    row: int,
    offset: Offset,
    world: Disturbance | None,
    spec: Specification,
) -> str:
    """The outcome, a key of OUTCOMES, where the robot arrives `offset` from candidate `row`.

    The robot knows where it stands and plans from there. With a `world` the plan is executed in it; the robot
    knows neither its target pose nor its friction and mass, and its `T_base_moved` is not used. Depends on
    these arguments alone. Without offset and world it equals the candidate's outcome in a run of `plan`, or
    in the draw of `at`.
    """
    T_arrived = at.base_pose(candidates, row) @ yaw_pose(offset[0], offset[1], 0.0, offset[2])
    if not fits_at(at, [T_arrived], candidates, row, spec)[0]:
        return "base_collision"
    if len(at.grasps) == 0:
        return "no_grasp"
    if not at.is_within_reach(T_arrived):
        return "out_of_reach"
    rng = at.path_generator(int(candidates.index[row]), spec)
    report = plan_candidate(at.planning, T_arrived, rng)
    if report.plan is None or world is None:
        return report.outcome
    unknown = replace(world, T_base_moved=np.eye(4))
    return run_trial(at.trials, T_arrived, report.plan, unknown).outcome
