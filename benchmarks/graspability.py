"""Which objects a gripper can take from a table: one line an object, and the list of targets.

    python -m benchmarks.graspability [--objects ycb:DIR] [--robot panda] [--stability] [--cold]

`clear`: poses in which the open hand touches neither the object nor the plane that it stands on; `scored`:
varied ones, tried in physics; `held`: share of the scored and clear ones that hold in at least `min_score` of
the trials. CPU seconds are those of this process; 0.0 where the grasps were in the cache.

`--cold` computes everything without the cache. `--stability` also repeats trials with half the timestep and
counts those that end differently.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace

import numpy as np

from datagen.schemas.specification import GraspParams
from datagen.workers.grasps.floating_hand import HandTest, held_trials
from datagen.workers.grasps.grasp_cache import scored_grasps
from datagen.workers.grasps.targets import JUDGED_GRASPS, Targets, is_graspable
from datagen.workers.objects import open_objects
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots import gripper_of
from datagen.workers.robots.gripper import Gripper

_STABILITY_GRASPS = 8  # settled with each object
_VARIANTS = {
    "20 position and 2 velocity iterations, 1/240 s (as used)": HandTest(),
    "40 and 8, 1/240 s": replace(HandTest(), position_iterations=40, velocity_iterations=8),
    "20 and 2, 1/480 s": replace(HandTest(), timestep_s=1 / 480),
}


def main() -> None:
    """Print the table, the targets, and how stable the trials are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--stability", action="store_true")
    options = parser.parse_args()
    if options.cold:
        os.environ["DATAGEN_CACHE"] = tempfile.mkdtemp(prefix="datagen-graspability-")
    source = open_objects(options.objects)
    gripper = gripper_of(options.robot)
    models = [source.load(name) for name in source.names()]
    print_table(models, gripper, GraspParams())
    known = Targets(source.names(), source.load, gripper, GraspParams())
    targets = [name for name in source.names() if known.is_target(name)]
    print(f"\n{len(targets)} targets: {', '.join(targets)}")
    if options.stability:
        print_stability(models, gripper)


def print_table(models: list[ObjectModel], gripper: Gripper, params: GraspParams) -> None:
    """One line an object, as Markdown, and the totals."""
    print("| object | parts | kg | clear | scored | held | graspable | CPU s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    begin, wall = time.process_time(), time.perf_counter()
    trials = 0
    for model in models:
        start = time.process_time()
        scored = scored_grasps(model, gripper, JUDGED_GRASPS)
        verdict = "yes" if is_graspable(model, gripper, params) else "no"
        spent_s = time.process_time() - start
        trials += 3 * len(scored)
        held = (scored.score[scored.is_clear] >= params.min_score).mean() if scored.is_clear.any() else 0.0
        print(
            f"| {model.name} | {len(model.convex_parts_m)} | {model.mass_kg:.2f} | {scored.n_clear} "
            f"| {len(scored)} | {held:.2f} | {verdict} | {spent_s:.1f} |",
            flush=True,
        )
    cpu_s, wall_s = time.process_time() - begin, time.perf_counter() - wall
    print(f"\n{len(models)} objects: {cpu_s:.0f} CPU s, {wall_s:.0f} s, about {trials} trials")


def print_stability(models: list[ObjectModel], gripper: Gripper) -> None:
    """Share of trials, and of grasps' verdicts, that change when the timestep is halved."""
    print("\n| physics | trials changed by half the step | verdicts changed | trials/CPU s |")
    print("| --- | --- | --- | --- |")
    for label, test in _VARIANTS.items():
        changed: list[float] = []
        verdicts: list[float] = []
        trials, spent_s = 0, 0.0
        for model in models:
            scored = scored_grasps(model, gripper, JUDGED_GRASPS)
            # Evenly over the list, so that not only its first grasps are tried.
            some = np.linspace(0, len(scored) - 1, min(_STABILITY_GRASPS, len(scored))).astype(int)
            if len(some) == 0:
                continue
            T, opening_m = scored.T_object_tcp[some], scored.opening_m[some].astype(np.float64)
            start = time.process_time()
            held = [
                held_trials(
                    model.convex_parts_m,
                    model.mass_kg,
                    gripper,
                    T,
                    opening_m,
                    np.random.Generator(np.random.PCG64(0)),
                    replace(test, timestep_s=step_s),
                )
                for step_s in (test.timestep_s, test.timestep_s / 2)
            ]
            spent_s += (time.process_time() - start) / 3  # the halved step costs twice as much
            trials += held[0].size
            changed.append(float((held[0] != held[1]).mean()))
            good = [h.mean(axis=1) >= GraspParams().min_score for h in held]
            verdicts.append(float((good[0] != good[1]).mean()))
        print(
            f"| {label} | {np.mean(changed):.1%} | {np.mean(verdicts):.1%} | {trials / spent_s:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
