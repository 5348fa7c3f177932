"""Convex parts merged for physics: parts left, geometric error, time of merging and of a physics step.

    python -m benchmarks.hulls [--objects ycb:DIR] [--limit 16] [--steps 1000] [--quick]

Objects with more parts than the limit. `us/step` is one object at rest on a table in SAPIEN's physics,
before and after; all times are CPU time of one core.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence

import numpy as np
import sapien
from sapien import physx

from datagen.workers.geometry.mesh import F32
from datagen.workers.geometry.transforms import translation
from datagen.workers.objects import open_objects
from datagen.workers.objects.part_merging import merge_parts
from datagen.workers.settling.sapien_physics import add_object, add_static
from tests.workers.objects.merging_errors import added_volume_share, cut_off_m, error_m


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--limit", type=int, default=16)
    parser.add_argument("--steps", type=int, default=1000, help="of physics, for each time")
    parser.add_argument("--quick", action="store_true", help="200 steps of 4 objects")
    options = parser.parse_args()
    objects = open_objects(options.objects)
    models = [objects.load(name) for name in objects.names()]
    models = [model for model in models if len(model.convex_parts_m) > options.limit]
    if options.quick:
        models, options.steps = models[:4], 200
    print(f"{len(models)} of {len(objects.names())} objects have more than {options.limit} convex parts")
    print(
        f"{'object':<24} {'parts':>5} {'left':>4} {'error mm':>8} {'cut mm':>6} {'volume':>7}"
        f" {'merge ms':>8} {'us/step':>7} {'merged':>6} {'ratio':>5}"
    )
    with tempfile.TemporaryDirectory() as folder:  # empty: no merged parts are read from the cache
        os.environ["DATAGEN_CACHE"] = folder
        ratios = []
        for model in models:
            started_s = time.process_time()
            parts_m = model.convex_parts_m
            merged = merge_parts(parts_m, options.limit)
            took_ms = 1e3 * (time.process_time() - started_s)
            before, after = (step_us(parts, model.mass_kg, options.steps) for parts in (parts_m, merged))
            ratios.append(before / after)
            print(
                f"{model.name:<24} {len(parts_m):>5} {len(merged):>4} {1e3 * error_m(parts_m, merged):>8.1f}"
                f" {1e3 * cut_off_m(parts_m, merged):>6.2f}"
                f" {100 * added_volume_share(parts_m, merged):>+6.0f}% {took_ms:>8.0f}"
                f" {before:>7.0f} {after:>6.0f} {ratios[-1]:>5.1f}"
            )
    if ratios:
        print(f"median ratio of the times of a step: {np.median(ratios):.1f}")


def step_us(parts_m: Sequence[F32], mass_kg: float, steps: int) -> float:
    """CPU time of a step with an object, kept awake, on a table."""
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    scene.set_timestep(1 / 200)
    material = physx.PhysxMaterial(0.6, 0.6, 0.0)
    corners = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.1, 0.0]), axis=-1)
    add_static(scene, [corners.reshape(-1, 3).astype(np.float32)], material)
    lowest = min(float(part[:, 2].min()) for part in parts_m)
    body = add_object(scene, parts_m, mass_kg, translation(0, 0, 0.001 - lowest), material)
    for _ in range(100):
        scene.step()
    started_s = time.process_time()
    for _ in range(steps):
        body.wake_up()
        scene.step()
    return 1e6 * (time.process_time() - started_s) / steps


if __name__ == "__main__":
    main()
