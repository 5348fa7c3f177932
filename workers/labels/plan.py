"""Label source `plan`: a candidate is good where the arm has a whole plan to a grasp and the lift."""

from __future__ import annotations

import numpy as np

from schemas.cost import StageClock
from schemas.fields import OUTCOMES
from schemas.specification import Specification
from workers.bases.candidates import Candidates
from workers.labels import distance_visibility
from workers.labels.source import Columns, LabelSource
from workers.labels.trials import ArmInScene, CandidateTrial, arm_in_scene, target_tcp, try_candidate
from workers.scenes.scene import SettledScene

VERSION = 1
_CODES = {name: code for code, name in enumerate(OUTCOMES)}


def label(scene: SettledScene, candidates: Candidates, spec: Specification, clock: StageClock) -> Columns:
    """The columns of the heuristic, and what planning found out about every candidate."""
    return label_with_trials(scene, candidates, spec, clock)[0]


def label_with_trials(
    scene: SettledScene, candidates: Candidates, spec: Specification, clock: StageClock
) -> tuple[Columns, list[CandidateTrial]]:
    """The columns of `plan`, and the trials they were read from, one a candidate."""
    columns = distance_visibility.label(scene, candidates, spec, clock)
    columns["heuristic_label"] = columns["label"]
    n = len(candidates)
    columns |= {
        "outcome": np.zeros(n, np.uint8),
        "grasps_free": np.zeros(n, np.int16),
        "grasps_tried": np.zeros(n, np.int16),
        "T_target_tcp": np.tile(np.eye(4, dtype=np.float32), (n, 1, 1)),
        "grasp_score": np.zeros(n, np.float32),
        "q_grasp_rad": np.zeros((n, 7), np.float32),
        "path_length_rad": np.zeros(n, np.float32),
        "path_clearance_m": np.zeros(n, np.float32),
    }
    arms: dict[tuple[float, float], ArmInScene] = {}
    trials: list[CandidateTrial] = []
    for row in range(n):
        key = (float(candidates.arm_reach_m[row]), float(candidates.base_height_m[row]))
        if key not in arms:
            arms[key] = arm_in_scene(scene, candidates, row, spec, clock)
        trial = try_candidate(arms[key], candidates, row, spec)
        trials.append(trial)
        _write(columns, row, arms[key], candidates, trial)
    columns["label"] = (columns["outcome"] == _CODES["success"]).astype(np.uint8)
    return columns, trials


def _write(columns: Columns, row: int, at: ArmInScene, candidates: Candidates, trial: CandidateTrial) -> None:
    columns["outcome"][row] = _CODES[trial.outcome]
    if trial.report is not None:
        columns["grasps_free"][row] = trial.report.grasps_free
        columns["grasps_tried"][row] = trial.report.grasps_tried
    plan = trial.plan
    if plan is None:
        return
    columns["T_target_tcp"][row] = target_tcp(at, at.base_pose(candidates, row), plan)
    columns["grasp_score"][row] = at.grasps.score[plan.grasp]
    columns["q_grasp_rad"][row] = plan.q_approach_rad[-1]
    columns["path_length_rad"][row] = plan.length_rad
    columns["path_clearance_m"][row] = plan.clearance_m


PLAN = LabelSource("plan", VERSION, "plan", label)
