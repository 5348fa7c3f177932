"""Columns of random candidates: metrics care for numbers, not for where they come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from datagen.evaluation.columns import Columns


def make_columns(
    rng: np.random.Generator,
    n_scenes: int = 12,
    per_scene: int = 20,
    scores: Mapping[str, np.ndarray] | None = None,
    positive_share: float = 0.3,
) -> Columns:
    """Scenes of one robot each; positives are clear and within reach, as simulated ones are."""
    n = n_scenes * per_scene
    scene = np.repeat(np.arange(n_scenes), per_scene)
    is_clear = rng.random(n) < 0.7
    mount_m = rng.uniform(0, 1.5, n).astype(np.float32)
    reach_m = np.repeat(rng.uniform(0.5, 1.0, n_scenes).astype(np.float32), per_scene)
    label = (rng.random(n) < positive_share) & is_clear & (mount_m <= reach_m)
    base_xy_m = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    return Columns(
        scene=scene,
        robot=scene.copy(),
        label=label,
        is_clear=is_clear,
        base_xy_m=base_xy_m,
        mount_distance_m=mount_m,
        reach_m=reach_m,
        scores=dict(scores) if scores is not None else {"random": rng.random(n)},
        house=np.array([f"house-{k % 5}" for k in range(n_scenes)], object),
        place=np.arange(n_scenes, dtype=np.uint8) % 2,
        run=np.zeros(n_scenes, np.int64),
        is_grid=np.ones(n_scenes, np.bool_),
    )


def make_grids(label: np.ndarray, score: np.ndarray) -> Columns:
    """Four equal grids, all clear, their cells in random order; label and score (N, N) with rows along y."""
    rng, side = np.random.default_rng(0), len(label)
    made = make_columns(rng, 4, side**2)
    axis = np.linspace(-1, 1, side)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    order = np.concatenate([rng.permutation(side**2) for _ in range(4)])
    base_xy_m = np.stack([x.ravel(), y.ravel()], axis=1)[order].astype(np.float32)
    return replace(
        made,
        base_xy_m=base_xy_m,
        label=label.ravel()[order].astype(bool),
        is_clear=np.ones(len(made), bool),
        scores={"model": score.ravel()[order]},
    )
