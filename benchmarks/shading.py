"""CPU time of frames with shadows and sky, as `export --to frames` has them, and as labels have them.

    python -m benchmarks.shading RUN [--scenes FIRST:PAST]

The shortest of five renderings of each frame, in seconds of CPU, summed over the frames.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from datagen.console.options import AS_FOUND
from datagen.exports.export_run import open_source
from datagen.workers.rendering.embree import render_rays
from datagen.workers.rendering.shading import draw_light, render_shaded


def main() -> None:
    """Render the frames and print both sums and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--scenes")
    options = parser.parse_args()
    source, sums = open_source(options.run, options.scenes, AS_FOUND), np.zeros(2)
    for run, rows in source.scenes(source.first, source.past):
        scene = source.rebuilt(run, rows.record)
        rays, house, camera = scene.rays, scene.house.house, scene.camera
        light = draw_light(camera, np.random.default_rng(scene.index))
        sums[0] += _least_s(partial(render_rays, rays, camera))
        sums[1] += _least_s(partial(render_shaded, rays, house, camera, light))
    n = source.past - source.first
    print(f"{n} frames: {1000 * sums[0] / n:.0f} ms plain, {1000 * sums[1] / n:.0f} ms shaded,", end=" ")
    print(f"ratio {sums[1] / sums[0]:.2f}")


def _least_s(render: Callable[[], object]) -> float:
    times: list[float] = []
    for _ in range(5):
        start = time.process_time()
        render()
        times.append(time.process_time() - start)
    return min(times)


if __name__ == "__main__":
    main()
