"""Time of each model to rank one robot's candidates from a cloud, and of a training step.

    python -m benchmarks.scoring [--run RUN] [--candidates 600] [--threads 2]

The cloud is the first scene's of the run, or, without one, drawn at random on a table with the target
and clutter. Scoring takes numpy arrays and returns the order of the candidates: all that a robot waits for
is included. A training step: forward and backward over 4 scenes with 4 robots and 15 candidates each
(`paper`: one robot), without reading. Parameters are fresh: time does not depend on them. Times are medians
of wall time, listed with CPU time, which is more reliable on a busy machine.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

# Otherwise both threads may share a core. torch reads them when it is imported.
os.environ.setdefault("OMP_PROC_BIND", "true")
os.environ.setdefault("OMP_PLACES", "cores")

import numpy as np
import torch

from datagen.train.dataset import SampleStream
from datagen.train.inputs import Batch, CandidateInputs, Clouds, RobotInputs
from datagen.train.models import Model, build_model
from datagen.train.tensors import to_torch

LIGHT = {
    "centroids": (256, 64),
    "neighbours": (16, 32),
    "widths": ((32, 32, 64), (64, 64, 128), (128, 256, 512)),
    "head": (256, 128),
}
MODELS: list[tuple[str, str, dict[str, Any]]] = [
    ("shared, tokens alone", "shared", {"hand_poses": 0, "observed_visibility": False}),
    ("shared, and visibility", "shared", {"hand_poses": 0}),
    ("shared", "shared", {}),
    ("shared, as released", "shared", {"width": 96, "embedding": 160, "kinematics": True}),
    ("paper, lighter", "paper", LIGHT),
    ("paper", "paper", {}),
]
N_POINTS = 4096


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--run")
    parser.add_argument("--candidates", type=int, default=600)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--only", default="", help="models whose names begin so")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    clouds = _stored_clouds(options.run) if options.run else _drawn_clouds()
    print(f"{len(clouds)} clouds of {clouds.points_m.shape[1]} points, {options.threads} threads")
    print(f"{'model':<30} {'numbers':>9} {'ranking s':>9} {'CPU s':>6} {'step ms/sample':>14} {'CPU ms':>6}")
    for words, name, config in (m for m in MODELS if m[0].startswith(options.only)):
        model = build_model(name, config)
        slow = name == "paper"
        one = _batch(clouds, robots=1, candidates=options.candidates, scenes=1)
        several = _batch(clouds, robots=1, candidates=15, scenes=1) if slow else _batch(clouds, 4, 15, 4)
        step = [1e3 * s / len(several) for s in _time(partial(_step, model, several), 3 if slow else 9)]
        rank = _time(partial(_rank, model, one), 1 if slow else options.repeats)
        n = sum(p.numel() for p in model.parameters())
        print(
            f"{words:<30} {n:>9,} {rank[0]:>9.3f} {rank[1]:>6.2f} {step[0]:>14.2f} {step[1]:>6.2f}",
            flush=True,
        )


def _rank(model: Model, batch: Batch[Any]) -> None:
    model.eval()
    with torch.inference_mode():
        given = to_torch(batch, "cpu")
        logits = model.score(given.clouds, given.candidates, given.robots)
        (logits[:, 0] - logits[:, 1]).argsort().numpy()


def _step(model: Model, batch: Batch[Any]) -> None:
    model.train()
    given = to_torch(batch, "cpu")
    logits = model.score(given.clouds, given.candidates, given.robots)
    torch.nn.functional.cross_entropy(logits, given.label).backward()


def _time(work: Callable[[], None], repeats: int) -> tuple[float, float]:
    """Medians of wall and CPU seconds; several repeats follow one that is not timed."""
    if repeats > 1:
        work()
    wall, cpu = [], []
    for _ in range(repeats):
        started, busy = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - busy)
    return statistics.median(wall), statistics.median(cpu)


def _stored_clouds(run: str) -> Clouds[Any]:
    return next(iter(SampleStream([run], scenes_per_batch=4, shuffle=False).epoch(0))).clouds


def _drawn_clouds(scenes: int = 4) -> Clouds[Any]:
    rng = np.random.default_rng(0)
    table = rng.uniform([-0.7, -0.5, -0.05], [0.7, 0.5, -0.04], (scenes, N_POINTS, 3))
    heaps = rng.uniform(-0.25, 0.25, (scenes, 7, 3)) * [1, 1, 0]
    heaps[:, 0] = 0
    on = rng.integers(0, 7, (scenes, N_POINTS))
    things = np.take_along_axis(heaps, on[..., None], 1) + rng.normal(0, 0.02, (scenes, N_POINTS, 3))
    bare = rng.random((scenes, N_POINTS)) < 0.6
    return Clouds(
        points_m=np.where(bare[..., None], table, things).astype(np.float32),
        rgb=rng.integers(0, 256, (scenes, N_POINTS, 3), dtype=np.uint8),
        target_mask=~bare & (on == 0),
        n_points=np.full(scenes, N_POINTS),
        target_height_m=np.full(scenes, 0.8, np.float32),
        target_radius_m=np.full(scenes, 0.06, np.float32),
    )


def _batch(clouds: Clouds[Any], robots: int, candidates: int, scenes: int) -> Batch[Any]:
    """The first clouds, again where they are too few, each with robots, each with candidates around it."""
    rng = np.random.default_rng(1)
    r, n = scenes * robots, scenes * robots * candidates
    return Batch(
        clouds=Clouds(
            **{name: values[np.arange(scenes) % len(values)] for name, values in vars(clouds).items()}
        ),
        robots=RobotInputs(
            np.repeat(np.arange(scenes), robots),
            *(
                rng.uniform(low, high, r).astype(np.float32)
                for low, high in ((0.8, 1.5), (0.5, 1.0), (0.7, 1.0))
            ),
        ),
        candidates=CandidateInputs(
            np.repeat(np.arange(r), candidates), rng.uniform(-1, 1, (n, 2)).astype(np.float32)
        ),
        label=rng.integers(0, 2, n),
        sample_id=np.zeros((n, 16), np.uint8),
    )


if __name__ == "__main__":
    main()
