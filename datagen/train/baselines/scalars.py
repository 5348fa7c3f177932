"""Baseline: small networks on 11 numbers per candidate, without shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.baselines.baseline import labels, mount_m, observed_rho, planar_distance_m, reach_m
from datagen.train.baselines.networks import MEMBERS, Layer, fit_networks
from datagen.train.baselines.observed_clearance import observed_clearance_m
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
    name = "scalars"
    threshold = 0.5

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
        return replace(self, layers=fit_networks(rows, label[clear], held_out, rng, self.steps))

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
