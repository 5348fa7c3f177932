"""Sanity checks of the physics: one parameter of the trials changed at a time, over the same planned grasps.

    python -m benchmarks.physical_sense [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 12]

Planned candidates (clear and in range) are executed once by default, once more to see that nothing
changes, then with other friction, mass, grip force, timestep and disturbances. A row has the
share that succeeds, and the share of the default's labels that flip. "label" is the label of `sim`, plans
included; the other rows execute the first plan alone.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.options import scene_options
from datagen.configuration.specify import specify
from datagen.schemas.identity import Stream, generator
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import DisturbanceParams, Specification, TrialParams
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.geometry.mesh import F64
from datagen.workers.houses import open_houses
from datagen.workers.labels.arm_labelling import (
    ArmInScene,
    arm_in_scene,
    arm_of,
    draw_disturbances,
    try_candidate,
)
from datagen.workers.motion import MotionPlan
from datagen.workers.objects import open_objects
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.trials import Disturbance
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.trial_scene import prepare_trials
from datagen.workers.world import assemble_world


@dataclass(frozen=True, eq=False)
class Case:
    """A planned candidate."""

    at: ArmInScene
    candidates: SceneCandidates
    row: int
    T_world_base: F64
    plan: MotionPlan


def main() -> None:
    """Print the tables."""
    parser = plan_options(__doc__)
    parser.add_argument("--timestep-only", action="store_true", help="only the rows of whole labels")
    options = parser.parse_args()
    spec, cases = planned_cases(options)
    trial = arm_of(spec).trial
    assert trial is not None
    print(f"{len(cases)} planned candidates in {options.scenes} scenes")
    if not options.timestep_only:
        print_single(spec, cases, trial)
    print_labels(spec, cases, trial)


def plan_options(about: str | None) -> argparse.ArgumentParser:
    """A parser with the options of `planned_cases`."""
    parser = scene_options(about)
    parser.add_argument("--candidates", type=int, default=40, help="a scene")
    parser.add_argument("--plans", type=int, default=8, help="most planned candidates taken from a scene")
    return parser


def planned_cases(options: argparse.Namespace) -> tuple[Specification, list[Case]]:
    """Candidates with a plan, from scenes drawn as a run draws them."""
    houses, objects = open_houses(options.houses), open_objects(options.objects)
    fields = {
        "seed": options.seed,
        "candidates.per_scene": options.candidates,
        "candidates.robots_per_scene": 1,
        "candidates.within": "in-range",
        "scene.places": {},  # open tops
    }
    spec = specify("sim", houses, objects, fields, None)
    plan_only = spec.model_copy(update={"arm": arm_of(spec).model_copy(update={"trial": None})})
    world = assemble_world(spec, houses, objects, options.houses, options.objects)
    cases: list[Case] = []
    for index in range(options.scenes):
        scene, candidates = generate_scene(world, index, StageClock())
        at = arm_in_scene(scene, candidates, 0, plan_only, StageClock())
        found = 0
        for row in range(len(candidates)):
            made = try_candidate(at, candidates, row, plan_only)
            if made.plan is not None:
                cases.append(Case(at, candidates, row, at.base_pose(candidates, row), made.plan))
                found += 1
            if found == options.plans:
                break
    return spec, cases


def outcomes(
    cases: list[Case], trial: TrialParams, disturb: Callable[[Case], Disturbance] | None = None
) -> list[str]:
    """Outcomes of the first plan of every case."""
    ends: list[str] = []
    for case in cases:
        at = case.at
        prepared = prepare_trials(at.scene, at.robot, trial, at.base_radius_m)
        disturbance = disturb(case) if disturb else Disturbance.none(trial.object_friction)
        ends.append(run_trial(prepared, case.T_world_base, case.plan, disturbance).outcome)
    return ends


def print_single(spec: Specification, cases: list[Case], trial: TrialParams) -> None:
    """The first plan alone, one parameter at a time."""
    base = outcomes(cases, trial)
    print(f"\n{'first plan alone':34}{'success':>9}{'flips':>8}   failures")
    print_row("default", base, base)
    print_row("default again", outcomes(cases, trial), base)
    for friction in (0.02, 0.05, 0.1, 0.2, 0.4):
        # A pair has the mean of the two frictions, so both are set.
        changed = trial.model_copy(update={"object_friction": friction, "finger_friction": friction})
        print_row(f"friction of pads and object {friction}", outcomes(cases, changed), base)
    for force_n in (0.5, 1.0, 2.0, 5.0, 10.0, 70.0):
        changed = trial.model_copy(update={"grip_force_n": force_n})
        print_row(f"grip force {force_n} N", outcomes(cases, changed), base)
    for scale in (5.0, 20.0, 1000.0):
        heavy = replace(Disturbance.none(trial.object_friction), mass_scale=scale)
        print_row(f"mass x {scale:g}", outcomes(cases, trial, lambda _, heavy=heavy: heavy), base)
    for std_m in (0.005, 0.01, 0.02, 0.04):
        print_row(f"target off by {1000 * std_m:g} mm", outcomes(cases, trial, off(spec, std_m, 0.0)), base)
    for std_m in (0.005, 0.01, 0.02, 0.04):
        print_row(f"base off by {1000 * std_m:g} mm", outcomes(cases, trial, off(spec, 0.0, std_m)), base)


def off(spec: Specification, target_m: float, base_m: float) -> Callable[[Case], Disturbance]:
    """A disturbance of positions alone, drawn for each case."""
    still = {"low": 1.0, "high": 1.0}
    trial = arm_of(spec).trial
    assert trial is not None
    friction = {"low": trial.object_friction, "high": trial.object_friction}
    params = DisturbanceParams.model_validate(
        {
            "repeats": 1,
            "target_position_std_m": target_m,
            "target_yaw_std_rad": 0.0,
            "base_position_std_m": base_m,
            "base_yaw_std_rad": 0.0,
            "object_friction": friction,
            "mass_scale": still,
        }
    )

    def draw(case: Case) -> Disturbance:
        scene = case.at.scene
        rng = generator(spec.seed, Stream.DISTURBANCE, scene.index, scene.retry, case.row)
        return draw_disturbances(params, scene.T_world_object[0], rng)[0]

    return draw


def print_labels(spec: Specification, cases: list[Case], trial: TrialParams) -> None:
    """Whole labels, by timestep."""
    base = labels(spec, cases, trial)
    print(f"\n{'label':34}{'success':>9}{'flips':>8}   failures")
    print_row(f"timestep {1000 * trial.timestep_s:.3g} ms", base, base)
    half = trial.model_copy(update={"timestep_s": trial.timestep_s / 2})
    print_row(f"timestep {1000 * half.timestep_s:.3g} ms", labels(spec, cases, half), base)


def labels(spec: Specification, cases: list[Case], trial: TrialParams) -> list[str]:
    """Outcomes as `sim` decides them."""
    arm = arm_of(spec).model_copy(update={"trial": trial})
    return [
        try_candidate(
            ArmInScene(c.at.scene, c.at.robot, c.at.grasps, arm, c.at.base_radius_m),
            c.candidates,
            c.row,
            spec.model_copy(update={"arm": arm}),
        ).outcome
        for c in cases
    ]


def print_row(name: str, ends: list[str], base: list[str]) -> None:
    """Share of successes, and share of labels that differ from the default's."""
    good = np.array([end == "success" for end in ends])
    flips = good != np.array([end == "success" for end in base])
    failures = Counter(end for end in ends if end != "success")
    text = ", ".join(f"{cause} {count}" for cause, count in failures.most_common())
    print(f"{name:34}{100 * good.mean():8.1f}%{100 * flips.mean():7.1f}%   {text}")


if __name__ == "__main__":
    main()
