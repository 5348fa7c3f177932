"""Small batches of random scenes: what baselines ask for, without a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from datagen.train.inputs import Batch, CandidateInputs, Clouds, RobotInputs


def make_batch(seed: int = 0, n_scenes: int = 3, per_robot: int = 20, points: int = 96) -> Batch[Any]:
    """Scenes with two robots each; labels follow the distance over the reach."""
    rng = np.random.default_rng(seed)
    robots = 2 * n_scenes
    n = robots * per_robot
    target_mask = np.zeros((n_scenes, points), np.bool_)
    target_mask[:, :24] = True
    points_m = rng.uniform(-0.6, 0.6, (n_scenes, points, 3)).astype(np.float32)
    points_m[target_mask] *= 0.08
    robot_row = np.repeat(np.arange(robots), per_robot)
    base_xy_m = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    reach_m = rng.uniform(0.5, 1.0, robots).astype(np.float32)
    near = np.linalg.norm(base_xy_m, axis=1) < 0.8 * reach_m[robot_row]
    clear = rng.random(n) < 0.8
    return Batch(
        clouds=Clouds(
            points_m=points_m,
            rgb=rng.integers(0, 256, (n_scenes, points, 3)).astype(np.uint8),
            target_mask=target_mask,
            n_points=np.full(n_scenes, points),
            target_height_m=rng.uniform(0.5, 1.0, n_scenes).astype(np.float32),
            target_radius_m=np.full(n_scenes, 0.08, np.float32),
        ),
        robots=RobotInputs(
            cloud_row=np.repeat(np.arange(n_scenes), 2),
            camera_height_m=rng.uniform(0.8, 1.5, robots).astype(np.float32),
            base_height_m=rng.uniform(0.5, 1.0, robots).astype(np.float32),
            arm_reach_m=reach_m,
        ),
        candidates=CandidateInputs(robot_row=robot_row, base_xy_m=base_xy_m),
        label=(near & clear).astype(np.int64),
        sample_id=rng.integers(0, 256, (n, 16)).astype(np.uint8),
        extra={
            "base_is_clear": clear,
            "house_id": np.array([f"house {seed} {k}" for k in range(n_scenes)], object),
            "object_name": np.array([["003_cracker_box"] * 7] * n_scenes, object),
        },
    )


def take(batch: Batch[Any], rows: np.ndarray) -> Batch[Any]:
    """Some of the candidates, in this order."""
    c = batch.candidates
    return replace(
        batch,
        candidates=CandidateInputs(c.robot_row[rows], c.base_xy_m[rows]),
        label=batch.label[rows],
        sample_id=batch.sample_id[rows],
        extra={**batch.extra, "base_is_clear": batch.extra["base_is_clear"][rows]},
    )


def moved(batch: Batch[Any], base_xy_m: np.ndarray) -> Batch[Any]:
    """The candidates elsewhere."""
    return replace(
        batch, candidates=CandidateInputs(batch.candidates.robot_row, base_xy_m.astype(np.float32))
    )
