"""Baseline: small networks on 11 numbers per candidate, without shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from datagen.schemas.errors import InputError
from datagen.schemas.specification import CandidateParams
from datagen.train.baselines.baseline import (
    labels,
    mount_m,
    observed_rho,
    planar_distance_m,
    reach_m,
    refitted_cut,
)
from datagen.train.inputs import F64, Array, Batch, Bools, Ints, column, is_clear

FEATURES = (
    *("distance_m", "mount_distance_m", "reach_m", "distance_over_reach", "mount_over_reach", "rise_m"),
    *("camera_rise_m", "target_height_m", "target_radius_m", "observed_rho", "observed_clearance_m"),
)


@dataclass(frozen=True, eq=False)
class Scalars:
    """Probability of a positive label, the mean of five networks; 0 where the base is not clear.

    Each network has its own random initial weights and leaves out a fifth of the houses. All stop at the step
    with the lowest loss on the houses left out. A robot knows all features before it moves.
    """

    seed: int = 0
    steps: int = 6000  # at most
    layers: tuple[Layer, ...] = ()  # the first takes the features as they are
    threshold: float = 0.5  # `fit` sets it for the best balanced accuracy of feasible candidates
    name = "scalars"

    @property
    def needs_fit(self) -> bool:
        return not self.layers

    def score(self, batch: Batch[Array]) -> F64:
        """Probabilities (N,)."""
        if not self.layers:
            raise InputError("baseline scalars", "", "is not fitted", "Fit it on runs in validation houses")
        hidden = features(batch)[None]
        for weights, bias in self.layers[:-1]:
            hidden = np.maximum(hidden @ weights + bias, 0)
        weights, bias = self.layers[-1]
        logits = (hidden @ weights + bias)[:, :, 0]
        chance = (1 / (1 + np.exp(-np.clip(logits, -50, 50)))).mean(0)
        return np.where(is_clear(batch), chance, 0.0)

    def fit(self, batches: Sequence[Batch[Array]]) -> Scalars:
        """Fit; the result depends only on batches and seed. InputError with fewer than five scenes."""
        label = labels(batches, self.name)
        clear = np.concatenate([is_clear(b) for b in batches])
        if not clear.any():
            problem = "no candidate is clear, so nothing can be fitted"
            raise InputError(
                "baseline scalars", "base_is_clear", problem, "Fit on runs with clear candidates"
            )
        rows = np.concatenate([features(b) for b in batches])[clear]
        rng = np.random.default_rng(self.seed)
        held_out = _parts(batches, clear, rng)
        fitted = replace(self, layers=fit_networks(rows, label[clear], held_out, rng, self.steps))
        return replace(fitted, threshold=refitted_cut(fitted, batches, self.threshold))

    def state(self) -> dict[str, Any]:
        return {
            "threshold": self.threshold,
            "features": FEATURES,
            "layers": [[w.tolist(), b.tolist()] for w, b in self.layers],
        }


def features(batch: Batch[Array]) -> F64:
    """The numbers (N, 11) of every candidate, in the order of `FEATURES`."""
    robot = batch.candidates.robot_row
    cloud = batch.robots.cloud_row[robot]
    height_m = batch.clouds.target_height_m[cloud].astype(np.float64)
    planar, mount, reach = planar_distance_m(batch), mount_m(batch), reach_m(batch)
    rise = height_m - batch.robots.base_height_m[robot]
    camera_rise = batch.robots.camera_height_m[robot] - height_m
    radius = batch.clouds.target_radius_m[cloud]
    distances = (planar, mount, reach, planar / reach, mount / reach)
    seen = (observed_rho(batch), observed_clearance_m(batch))
    return np.column_stack([*distances, rise, camera_rise, height_m, radius, *seen])


def _parts(batches: Sequence[Batch[Array]], kept: Bools, rng: np.random.Generator) -> Ints:
    """Number of the network that leaves out each kept candidate, by house, or by scene with few houses."""
    scenes: list[Ints] = []
    houses: list[Array] = []
    seen = 0
    for batch in batches:
        cloud = batch.robots.cloud_row[batch.candidates.robot_row]
        scenes.append(seen + cloud)
        houses.append(column(batch, "house_id")[cloud].astype(str))
        seen += len(batch.clouds)
    names, group = np.unique(np.concatenate(houses)[kept], return_inverse=True)
    if len(names) < MEMBERS:
        names, group = np.unique(np.concatenate(scenes)[kept], return_inverse=True)
    if len(names) < MEMBERS:
        problem = f"come from {len(names)} scenes, of which {MEMBERS} networks cannot each leave out one"
        raise InputError("baseline scalars", "labels", problem, "Fit on runs with more scenes")
    return (rng.permutation(len(names)) % MEMBERS)[group]


# Lower points are floor, within the error of a depth camera.
_FLOOR_M = 0.05
# Clearances are capped here: the cloud ends a metre around the target.
FAR_M = 1.0
_BASES = CandidateParams(scaled_base=True)  # as in `datagen predict`


def observed_clearance_m(batch: Batch[Array]) -> F64:
    """Horizontal distance (N,) from each base to the nearest observed obstacle (m), at most `FAR_M`.

    Negative where a point lies inside the base. Obstacles are points above the floor and below the arm's
    mount. Unobserved space is free.
    """
    clouds, robots = batch.clouds, batch.robots
    clearance = np.full(len(batch), FAR_M)
    order = np.argsort(batch.candidates.robot_row, kind="stable")
    ends = np.searchsorted(batch.candidates.robot_row[order], np.arange(len(robots) + 1))
    for robot in np.flatnonzero(np.diff(ends)):
        rows, cloud = order[ends[robot] : ends[robot + 1]], int(robots.cloud_row[robot])
        points_m = clouds.points_m[cloud, : int(clouds.n_points[cloud])].astype(np.float64)
        height_m = points_m[:, 2] + clouds.target_height_m[cloud]
        # Points that are not finite fail the comparisons.
        low = (height_m > _FLOOR_M) & (height_m < robots.base_height_m[robot])
        if not low.any():
            continue
        radius_m = float(_BASES.radius_of_base_m(float(robots.arm_reach_m[robot])))
        away_m, _ = KDTree(points_m[low, :2]).query(batch.candidates.base_xy_m[rows].astype(np.float64))
        clearance[rows] = np.minimum(away_m - radius_m, FAR_M)
    return clearance


MEMBERS = 5
_WIDTH, _BATCH, _RATE, _DECAY = 32, 256, 3e-3, 1e-4
_MEAN = 0.995  # decay of the mean of weights over steps, which is validated and used
_EVERY = 50  # steps between validations on held-out rows
_PATIENCE = 1000  # steps without a lower held-out loss before the fit stops

Layer = tuple[F64, F64]  # weights (MEMBERS, in, out), bias (MEMBERS, 1, out)


def fit_networks(
    rows: F64, label: Bools, held_out: Ints, rng: np.random.Generator, steps: int
) -> tuple[Layer, ...]:
    """Layers of `MEMBERS` networks with one logit, of two hidden layers each, fitted to rows (N, F).

    Network k never learns from the rows whose `held_out` (N,) is k. Weights are exponential means over the
    steps, kept at the step with the lowest mean cross-entropy on held-out rows; at most `steps`.
    """
    import torch
    from torch.nn.functional import binary_cross_entropy_with_logits

    mean = rows.mean(0)
    # Features that hardly vary here must not be amplified.
    scale = np.maximum(rows.std(0), 1e-2)
    x = torch.from_numpy(((rows - mean) / scale).astype(np.float32))
    y = torch.from_numpy(label.astype(np.float32))
    learned = [np.flatnonzero(held_out != k) for k in range(MEMBERS)]
    judged = [torch.from_numpy(np.flatnonzero(held_out == k)) for k in range(MEMBERS)]
    now = [
        torch.from_numpy(rng.uniform(-1, 1, (MEMBERS, size, b)) / np.sqrt(a)).float().requires_grad_()
        for a, b in pairwise((rows.shape[1], _WIDTH, _WIDTH, 1))
        for size in (a, 1)
    ]
    averaged = [p.detach().clone() for p in now]
    kept, lowest, at = averaged, np.inf, 0

    def logits(x: torch.Tensor, parameters: list[torch.Tensor]) -> torch.Tensor:
        first, *others = (parameters[k : k + 2] for k in range(0, len(parameters), 2))
        hidden = torch.baddbmm(first[1], x, first[0])
        for weights, bias in others:
            hidden = torch.baddbmm(bias, torch.relu(hidden), weights)
        return hidden[..., 0]

    optimiser = torch.optim.AdamW(now, lr=_RATE, weight_decay=_DECAY)
    for step in range(1, steps + 1):
        chosen = torch.from_numpy(np.stack([rng.choice(some, _BATCH) for some in learned]))
        # The sum over networks: each has the gradient that it would have alone.
        loss = MEMBERS * binary_cross_entropy_with_logits(logits(x[chosen], now), y[chosen])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            for smooth, p in zip(averaged, now, strict=True):
                smooth.lerp_(p, 1 - _MEAN)
            if step % _EVERY == 0 or step == steps:
                losses = [
                    binary_cross_entropy_with_logits(
                        logits(x[None, some], [p[k : k + 1] for p in averaged])[0], y[some]
                    )
                    for k, some in enumerate(judged)
                ]
                if (held := float(torch.stack(losses).mean())) < lowest:
                    kept, lowest, at = [p.clone() for p in averaged], held, step
                elif step - at >= _PATIENCE:
                    break
    arrays = [p.double().numpy() for p in kept]
    layers = [(arrays[k], arrays[k + 1]) for k in range(0, len(arrays), 2)]
    # The normalisation of features is folded into the first layer.
    weights = layers[0][0] / scale[:, None]
    layers[0] = weights, layers[0][1] - (mean @ weights)[:, None]
    return tuple(layers)
