"""Label sources of an arm: positive where it has a complete plan for grasp and lift (`plan`), and where that
plan, executed in physics, lifts and holds the target (`sim`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from datagen.schemas.fields import OUTCOMES, RETRY_OUTCOMES
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import Specification
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.labels import Columns, LabelSource, heuristic_source
from datagen.workers.labels.arm_labelling import (
    ArmInScene,
    CandidateTrial,
    arm_in_scene,
    arm_of,
    try_candidate,
)
from datagen.workers.motion import MotionPlan
from datagen.workers.scenes import SettledScene
from datagen.workers.watched_clock import count_label

# 4: planned by machine code; all free grasps in reach are tried, then poses near them.
VERSION = 4
# 2: the first grasp alone decides, lift and slip are measured at the grasp, thrown objects are `unstable`.
# 4: plans are those of `plan` labels of version 4.
SIM_VERSION = 4
_CODES, _RETRY_CODES = ({name: code for code, name in enumerate(each)} for each in (OUTCOMES, RETRY_OUTCOMES))


def label(
    scene: SettledScene, candidates: SceneCandidates, spec: Specification, clock: StageClock
) -> Columns:
    """The columns of the heuristic, and results of planning."""
    return label_with_trials(scene, candidates, spec, clock)[0]


def label_with_trials(
    scene: SettledScene, candidates: SceneCandidates, spec: Specification, clock: StageClock
) -> tuple[Columns, list[CandidateTrial]]:
    """The columns of `plan`, and the trial behind each row."""
    tried = list(_trials(scene, candidates, spec, clock))
    return _columns(scene, candidates, spec, clock, tried), [trial for _, trial in tried]


def label_within(
    scene: SettledScene,
    candidates: SceneCandidates,
    spec: Specification,
    clock: StageClock,
    shares: tuple[float, float],
) -> Columns | None:
    """The columns of `plan` where the share of good ones among the candidates that are clear and in reach is
    within `shares`. None as soon as it is known not to be."""
    low, high = shares
    tried, good, among = list[_Tried](), 0, int((candidates.clearance_m >= 0).sum())
    for at, trial in _trials(scene, candidates, spec, clock):
        tried.append((at, trial))
        good += trial.outcome == "success"
        among -= trial.outcome == "out_of_reach"
        if good > 0 and good / among > high:
            return None
    if (good / among if among else 0.0) < low:
        return None
    return _columns(scene, candidates, spec, clock, tried)


_Tried = tuple[ArmInScene, CandidateTrial]  # by the first draw of its robot


def _trials(
    scene: SettledScene, candidates: SceneCandidates, spec: Specification, clock: StageClock
) -> Iterator[_Tried]:
    arms: dict[tuple[float, float, int], ArmInScene] = {}
    draws = arm_of(spec).draws or 1
    for row in range(len(candidates)):
        by_draw = list[CandidateTrial]()
        reach_m, height_m = float(candidates.arm_reach_m[row]), float(candidates.base_height_m[row])
        for draw in range(draws):
            key = (reach_m, height_m, draw)
            if key not in arms:
                arms[key] = arm_in_scene(scene, candidates, row, spec, clock, draw)
            by_draw.append(try_candidate(arms[key], candidates, row, spec))
        trial = by_draw[0]
        if draws > 1:
            plans, tries = sum(t.successes for t in by_draw), sum(t.trials for t in by_draw)
            trial = replace(trial, successes=plans, trials=tries)
        count_label(clock)
        yield arms[reach_m, height_m, 0], trial


def _columns(
    scene: SettledScene,
    candidates: SceneCandidates,
    spec: Specification,
    clock: StageClock,
    tried: Sequence[_Tried],
) -> Columns:
    """The columns of the heuristic and of planning."""
    columns = heuristic_source.label(scene, candidates, spec, clock)
    columns["heuristic_label"] = columns["label"]
    n = len(candidates)
    columns |= {
        "outcome": np.zeros(n, np.uint8),
        "grasps_free": np.zeros(n, np.int16),
        "grasps_tried": np.zeros(n, np.int16),
        "T_target_tcp": np.tile(np.eye(4, dtype=np.float32), (n, 1, 1)),
        "grasp_score": np.zeros(n, np.float32),
        "q_grasp_rad": np.zeros((n, arm_of(spec).joints or 7), np.float32),
        "path_length_rad": np.zeros(n, np.float32),
        "path_clearance_m": np.zeros(n, np.float32),
        "trials": np.zeros(n, np.int16),
        "successes": np.zeros(n, np.int16),
    }
    for row, (at, trial) in enumerate(tried):
        _write(columns, row, trial)
        if trial.plan is not None:
            _write_plan(columns, row, at, at.base_pose(candidates, row), trial.plan)
    columns["label"] = (columns["outcome"] == _CODES["success"]).astype(np.uint8)
    return columns


def _write(columns: Columns, k: int, trial: CandidateTrial) -> None:
    columns["outcome"][k] = _CODES[trial.outcome]
    columns["trials"][k], columns["successes"][k] = trial.trials, trial.successes
    if trial.report is not None:
        columns["grasps_free"][k] = trial.report.grasps_free
        columns["grasps_tried"][k] = trial.report.grasps_tried


def _write_plan(columns: Columns, k: int, at: ArmInScene, T_world_base: F64, plan: MotionPlan) -> None:
    T_world_tcp = T_world_base @ at.robot.T_base_tcp(plan.q_approach_rad[-1])
    columns["T_target_tcp"][k] = inverse(at.scene.T_world_object[0]) @ T_world_tcp
    columns["grasp_score"][k] = plan.grasp_score
    columns["q_grasp_rad"][k] = plan.q_approach_rad[-1]
    columns["path_length_rad"][k] = plan.length_rad
    columns["path_clearance_m"][k] = plan.clearance_m


def label_executed(
    scene: SettledScene, candidates: SceneCandidates, spec: Specification, clock: StageClock
) -> Columns:
    """The columns of `plan`, with outcomes and measurements of trials."""
    columns, trials = label_with_trials(scene, candidates, spec, clock)
    columns |= {
        "attempts": np.array([len(t.results) for t in trials], "int16"),
        "retry_outcome": np.array([_RETRY_CODES[t.retry_outcome or "none"] for t in trials], "uint8"),
        "lift_m": np.array([t.results[-1].lift_m if t.results else 0.0 for t in trials], "float32"),
        "slip_m": np.array([t.results[-1].slip_m if t.results else 0.0 for t in trials], "float32"),
        "disturbed_m": np.array([t.results[-1].disturbed_m if t.results else 0.0 for t in trials], "float32"),
        "simulated_s": np.array([sum(r.simulated_s for r in t.results) for t in trials], "float32"),
    }
    return columns


PLAN = LabelSource("plan", VERSION, "plan", label)
SIM = LabelSource("sim", SIM_VERSION, "sim", label_executed)
