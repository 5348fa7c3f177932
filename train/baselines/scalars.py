"""Baseline: a small network on 11 numbers per candidate, without shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.baselines.baseline import labels, mount_m, observed_rho, planar_distance_m, reach_m
from datagen.train.inputs import F64, Array, Batch, column, is_clear

FEATURES = (
    *("distance_m", "mount_distance_m", "reach_m", "distance_over_reach", "mount_over_reach"),
    *("rise_m", "camera_rise_m", "target_height_m", "target_radius_m", "observed_rho", "base_clearance_m"),
)
_WIDTH, _BATCH, _RATE, _DECAY = 32, 256, 3e-3, 1e-4

Layer = tuple[F64, F64]  # weights (out, in), bias (out,)


@dataclass(frozen=True, eq=False)
class Scalars:
    """Probability of a positive label by two hidden layers of 32; 0 where the base is not clear."""

    seed: int = 0
    steps: int = 3000
    layers: tuple[Layer, ...] = ()  # the first takes the features as they are
    name = "scalars"
    threshold = 0.5

    @property
    def needs_fit(self) -> bool:
        return not self.layers

    def score(self, batch: Batch[Array]) -> F64:
        """Probabilities (N,)."""
        if not self.layers:
            raise InputError("baseline scalars", "", "is not fitted", "Fit it on runs in validation houses")
        hidden = features(batch)
        for weights, bias in self.layers[:-1]:
            hidden = np.maximum(hidden @ weights.T + bias, 0)
        weights, bias = self.layers[-1]
        chance = 1 / (1 + np.exp(-np.clip((hidden @ weights.T + bias)[:, 0], -50, 50)))
        return np.where(is_clear(batch), chance, 0.0)

    def fit(self, batches: Sequence[Batch[Array]]) -> Scalars:
        """Fit; the result depends only on batches and seed."""
        label = labels(batches, self.name)
        clear = np.concatenate([is_clear(b) for b in batches])
        rows = np.concatenate([features(b) for b in batches])
        if not clear.any():
            problem = "no candidate is clear, so nothing can be fitted"
            raise InputError(
                "baseline scalars", "base_is_clear", problem, "Fit on runs with clear candidates"
            )
        label = label[clear].astype(np.float32)
        return replace(self, layers=_fitted(rows[clear], label, self.seed, self.steps))

    def state(self) -> dict[str, Any]:
        return {"features": FEATURES, "layers": [[w.tolist(), b.tolist()] for w, b in self.layers]}


def features(batch: Batch[Array]) -> F64:
    """The numbers (N, 11) of every candidate, in the order of `FEATURES`."""
    robot = batch.candidates.robot_row
    cloud = batch.robots.cloud_row[robot]
    height_m = batch.clouds.target_height_m[cloud].astype(np.float64)
    planar, mount, reach = planar_distance_m(batch), mount_m(batch), reach_m(batch)
    rise = height_m - batch.robots.base_height_m[robot]
    camera_rise = batch.robots.camera_height_m[robot] - height_m
    radius, clearance = batch.clouds.target_radius_m[cloud], column(batch, "base_clearance_m")
    distances = (planar, mount, reach, planar / reach, mount / reach)
    return np.column_stack([*distances, rise, camera_rise, height_m, radius, observed_rho(batch), clearance])


def _fitted(rows: F64, label: Array, seed: int, steps: int) -> tuple[Layer, ...]:
    import torch
    from torch import nn

    mean = rows.mean(0)
    # Features that hardly vary here must not be amplified.
    scale = np.maximum(rows.std(0), 1e-2)
    x = torch.from_numpy(((rows - mean) / scale).astype(np.float32))
    y = torch.from_numpy(label)
    draw = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        sizes = (rows.shape[1], _WIDTH, _WIDTH, 1)
        first, second, last = (nn.Linear(*widths) for widths in pairwise(sizes))
    net = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)
    optimiser = torch.optim.AdamW(net.parameters(), lr=_RATE, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        chosen = torch.randint(len(x), (min(_BATCH, len(x)),), generator=draw)
        loss = nn.functional.binary_cross_entropy_with_logits(net(x[chosen])[:, 0], y[chosen])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    linear = (first, second, last)
    layers = [(m.weight.detach().double().numpy(), m.bias.detach().double().numpy()) for m in linear]
    # The normalisation of features is folded into the first layer.
    weights = layers[0][0] / scale
    layers[0] = weights, layers[0][1] - weights @ mean
    return tuple(layers)
