"""Executed trials: cost by part, compared with whole simulation and ManiSkill; solver and timestep.

    python -m benchmarks.trials [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 12] [--maniskill 6]
                                [--solver] [--repeat-share 0.25]

Planned candidates (clear and in range) are sampled as a run samples them. The first plan of each is executed
as in runs and whole, with the reach and all of holding simulated, and labels that flip are counted. A share
of them is executed whole once more with friction larger by 1e-5 of it: such flips have no physical cause.
CPU seconds of this process; a rate is for one core. The first `--maniskill` of them are executed again in
`DatagenGrasp-v1` on `physx_cpu`, each built again as a trial is; loading ManiSkill is not counted.
`--solver` repeats all with other solver settings, each at its timestep and at half of it, undisturbed
and disturbed, and counts the successes that flip.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.physical_sense import Case, plan_options, planned_cases
from datagen.schemas.identity import Stream, generator
from datagen.schemas.specification import DisturbanceParams, Specification, TrialParams
from datagen.workers.labels.arm_labelling import arm_of, draw_disturbances
from datagen.workers.trials import Disturbance, TrialResult, execute, physics
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.trial_scene import (
    TrialScene,
    prepare_trials,
)


@dataclass(frozen=True)
class Solver:
    """Settings of one row of the solver table."""

    position_iterations: int
    velocity_iterations: int
    contact_offset_m: float
    frequency_hz: int


SOLVERS = (
    Solver(15, 1, 0.005, 200),
    Solver(15, 1, 0.002, 200),
    Solver(25, 4, 0.005, 200),
    Solver(40, 8, 0.005, 200),
    Solver(15, 1, 0.005, 400),
)


def main() -> None:
    """Print the tables."""
    parser = plan_options(__doc__)
    parser.add_argument("--maniskill", type=int, default=0, help="trials to execute in ManiSkill, too")
    parser.add_argument("--repeat-share", type=float, default=0.25, help="of trials, repeated to find chaos")
    parser.add_argument("--solver", action="store_true", help="the table of solver settings")
    options = parser.parse_args()
    spec, cases = planned_cases(options)
    trial = arm_of(spec).trial
    assert trial is not None
    print(f"{len(cases)} planned candidates in {options.scenes} scenes")
    own_s, results = print_cost(cases, trial)
    if options.plans >= options.candidates:
        n, failed = options.scenes * options.candidates, sum(r.outcome != "success" for r in results)
        print(f"plan and sim agree on {n - failed} of {n} candidates in range ({interval(n - failed, n)})")
    print_paired(cases, trial, results, options.repeat_share)
    if options.maniskill:
        print_maniskill(cases[: options.maniskill], trial, results, own_s)
    if options.solver:
        print_solvers(spec, cases, trial)


def print_cost(cases: list[Case], trial: TrialParams) -> tuple[list[float], list[TrialResult]]:
    """CPU seconds of every trial, and its result."""
    started_s = time.process_time()
    prepared = prepare_all(cases, trial)
    prepare_s = (time.process_time() - started_s) / len(set(map(id, prepared)))
    spent_s: list[float] = []
    phases_s: dict[str, float] = {}
    results: list[TrialResult] = []
    for case, scene in zip(cases, prepared, strict=True):
        started_s = time.process_time()
        with timed_phases(phases_s):
            results.append(
                run_trial(scene, case.T_world_base, case.plan, Disturbance.none(trial.object_friction))
            )
        spent_s.append(time.process_time() - started_s)
    build_s = build_time_s(cases, prepared, trial)
    simulated_s = float(np.mean([r.simulated_s for r in results]))
    mean_s = float(np.mean(spent_s))
    print(f"a trial: {1000 * mean_s:.0f} ms ({1 / mean_s:.1f}/s a core) for {simulated_s:.2f} simulated s")
    print(
        f"  of which a fresh scene: {1000 * build_s:.0f} ms; before, once a scene: {1000 * prepare_s:.0f} ms"
    )
    slow_s = np.quantile(spent_s, 0.9)
    print(f"  in ms: {phases_of(phases_s, len(cases))}")
    print(f"  90% end within {1000 * slow_s:.0f} ms, all within {1000 * max(spent_s):.0f} ms")
    print("  " + ", ".join(f"{n} {name}" for name, n in Counter(r.outcome for r in results).most_common()))
    return spent_s, results


def print_paired(
    cases: list[Case], trial: TrialParams, results: list[TrialResult], repeat_share: float
) -> None:
    """Whole simulation of the same trials: CPU by phase, flips, and flips of repeats of it."""
    prepared = prepare_all(cases, trial)
    repeated = generator(0, Stream.DISTURBANCE, 0).random(len(cases)) < repeat_share
    nearly = Disturbance.none(trial.object_friction * (1 + 1e-5))
    flips, chaos, successes = 0, 0, 0
    spent_s: dict[str, float] = {}
    for case, scene, result, again in zip(cases, prepared, results, repeated.tolist(), strict=True):
        at = (scene, case.T_world_base, case.plan, Disturbance.none(trial.object_friction))
        with timed_phases(spent_s):
            whole = run_trial(*at, whole=True).outcome == "success"
        successes += whole
        flips += whole != (result.outcome == "success")
        if again:
            other = run_trial(scene, case.T_world_base, case.plan, nearly, whole=True)
            chaos += whole != (other.outcome == "success")
    n = len(cases)
    print(f"whole: {1000 * sum(spent_s.values()) / n:.0f} ms: {phases_of(spent_s, n)}")
    mine = sum(r.outcome == "success" for r in results)
    print(f"  successes: {mine} as in runs, {successes} whole; flips {flips} of {n} ({interval(flips, n)})")
    m = int(repeated.sum())
    print(f"  friction x 1.00001, whole: flips {chaos} of {m} ({interval(chaos, m)})")


def phases_of(spent_s: dict[str, float], n: int) -> str:
    """Milliseconds a trial by phase."""
    return ", ".join(f"{part} {1000 * value / n:.1f}" for part, value in spent_s.items())


def interval(count: int, n: int) -> str:
    """The 95 % Wilson interval of a share, in percent."""
    if not n:
        return "none"
    z, p = 1.96, count / n
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = (100 * (middle + sign * half) / (1 + z * z / n) for sign in (-1, 1))
    return f"{100 * p:.1f} % [{low:.1f}, {high:.1f}]"


@contextmanager
def timed_phases(spent_s: dict[str, float]) -> Iterator[None]:
    """Add up CPU seconds of a trial by phase."""
    trial = execute._Trial  # pyright: ignore[reportPrivateUsage]
    kept = {name: getattr(trial, name) for name in ("_build", "_played", "_step")}

    def timed(method: Callable[..., Any], name: str | None) -> Callable[..., Any]:
        def run(self: Any, *given: Any, **named: Any) -> Any:
            started_s = time.process_time()
            value = method(self, *given, **named)
            part = name or given[0]
            spent_s[part] = spent_s.get(part, 0.0) + time.process_time() - started_s
            return value

        return run

    for method, part in (("_build", "build"), ("_played", "reach, played"), ("_step", None)):
        setattr(trial, method, timed(kept[method], part))
    try:
        yield
    finally:
        for name, method in kept.items():
            setattr(trial, name, method)


def prepare_all(cases: list[Case], trial: TrialParams) -> list[TrialScene]:
    """The prepared scene of every case, made once a scene and robot."""
    made: dict[int, TrialScene] = {}
    for case in cases:
        if id(case.at) not in made:
            made[id(case.at)] = prepare_trials(case.at.scene, case.at.robot, trial, case.at.base_radius_m)
    return [made[id(case.at)] for case in cases]


def build_time_s(cases: list[Case], prepared: list[TrialScene], trial: TrialParams) -> float:
    """Mean CPU seconds until the first step of a trial."""
    started_s = time.process_time()
    for case, scene in zip(cases, prepared, strict=True):
        physics.TrialWorld(scene, case.T_world_base, 0.0, trial.object_friction)
    return (time.process_time() - started_s) / len(cases)


def print_maniskill(
    cases: list[Case], trial: TrialParams, results: list[TrialResult], own_s: list[float]
) -> None:
    """The same trials in ManiSkill: time, ratio, agreement."""
    import gymnasium

    from examples.maniskill.environment import ENV_ID, DatagenGraspEnv, GraspTask, execute_plans

    spent_s, agree = 0.0, 0
    for case, scene, result in zip(cases, prepare_all(cases, trial), results, strict=False):
        task = GraspTask(scene, case.T_world_base, case.plan, Disturbance.none(trial.object_friction))
        env = gymnasium.make(ENV_ID, tasks=[task], obs_mode="none", reward_mode="none")
        unwrapped = env.unwrapped
        assert isinstance(unwrapped, DatagenGraspEnv)
        started_s = time.process_time()
        success = bool(execute_plans(unwrapped)[0])  # resets, which builds a fresh scene
        spent_s += time.process_time() - started_s
        agree += success == (result.outcome == "success")
        env.close()
    n = len(cases)
    ratio = spent_s / sum(own_s[:n])
    print(f"\nthe first {n} in ManiSkill: {1000 * spent_s / n:.0f} ms a trial ({n / spent_s:.2f}/s a core),")
    print(f"  {ratio:.1f} times as long as the trials here; the same success in {agree} of {n}")


def print_solvers(spec: Specification, cases: list[Case], trial: TrialParams) -> None:
    """Successes that flip when the timestep is halved, for every row of SOLVERS."""
    head = "undisturbed: success, flips   disturbed: success, flips"
    print(f"\n{'iterations':>11}{'offset':>8}{'rate':>7}{'ms':>6}   {head}")
    for solver in SOLVERS:
        physics.POSITION_ITERATIONS = solver.position_iterations
        physics.VELOCITY_ITERATIONS = solver.velocity_iterations
        physics.CONTACT_OFFSET_M = solver.contact_offset_m
        text, spent_s = "", 0.0
        for disturbed in (False, True):
            rows: list[np.ndarray] = []
            for factor in (1, 2):
                params = trial.model_copy(update={"timestep_s": 1 / (solver.frequency_hz * factor)})
                started_s = time.process_time()
                rows.append(successes(spec, cases, params, disturbed))
                spent_s += time.process_time() - started_s if factor == 1 and not disturbed else 0.0
            text += f"{rows[0].mean():20.3f}{int((rows[0] != rows[1]).sum()):4d} of {len(cases)}"
        its = f"{solver.position_iterations}/{solver.velocity_iterations}"
        milli_s, offset_mm = 1000 * spent_s / len(cases), 1000 * solver.contact_offset_m
        print(f"{its:>11}{offset_mm:6.0f}mm{solver.frequency_hz:5d}Hz{milli_s:6.0f}{text}", flush=True)


def successes(spec: Specification, cases: list[Case], params: TrialParams, disturbed: bool) -> np.ndarray:
    """Whether the first plan (N,) of every case succeeds, in the planned world or in one disturbed one."""
    out: list[bool] = []
    for k, (case, scene) in enumerate(zip(cases, prepare_all(cases, params), strict=True)):
        disturbance = Disturbance.none(params.object_friction)
        if disturbed:
            rng = generator(spec.seed, Stream.DISTURBANCE, k)
            T_world_target = case.at.scene.T_world_object[0]
            disturbance = draw_disturbances(DisturbanceParams(repeats=1), T_world_target, rng)[0]
        out.append(run_trial(scene, case.T_world_base, case.plan, disturbance).outcome == "success")
    return np.array(out)


if __name__ == "__main__":
    main()
