"""Predictive distribution of the cost of shards, for one quantity, from the shards made so far.

The cost of a shard is a linear model with two unknowns, the cost of a scene and the warm-up of a worker:

    cost = fixed + scene * scenes + warm_up * (exp(-before / T) - exp(-(before + scenes) / T)) + noise

`before` counts the scenes that its worker process made before. The first scenes of a process cost more, since
code, houses, objects and arms are loaded when they are first needed. The noise has a variance in proportion
to the scenes. Weighted least squares with conjugate priors give Student-t predictions (Gelman et al.,
Bayesian Data Analysis, ch. 14). The priors matter while few shards are seen: a scene's standard deviation
relative to its mean, so that two shards that happen to be alike do not give a narrow interval, and a warm-up
in scenes. A common factor stands for differences between two jobs: load of the machine, and its caches.

`benchmarks/forecast.py` measures how often the intervals hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from datagen.schemas.identity import Stream, generator

F64 = np.ndarray[Any, np.dtype[np.float64]]
Draws = F64  # (N_DRAWS,)

N_DRAWS = 1000
WARM_UP_SCENES = 6.0  # T
_PRIOR_SHARDS = 4.0  # weight of the prior of the noise, in shards
_WARM_UP, _WARM_UP_DEVIATION = 6.0, 6.0  # prior of a worker's warm-up, in scenes
_LEAST_SCENE = 0.1  # of the mean cost of the scenes seen
_MOST_SCHEDULED = 64  # workers whose shards are scheduled one by one


@dataclass(frozen=True)
class Interval:
    """An 80 % interval: the 10 %, 50 % and 90 % quantiles of a distribution."""

    low: float
    middle: float
    high: float

    @classmethod
    def of(cls, draws: Draws) -> Interval:
        low, middle, high = np.quantile(draws, [0.1, 0.5, 0.9])
        return cls(float(low), float(middle), float(high))

    def record(self) -> dict[str, float]:
        """Plain values for JSON."""
        return {"low": self.low, "middle": self.middle, "high": self.high}


@dataclass(frozen=True)
class Variation:
    """Variation of a quantity, relative to its mean.

    `scene`: prior standard deviation between scenes. `job`: that of the factor that the shards of one job
    have in common, compared with the shards seen.
    """

    scene: float
    job: float
    warms_up: bool = True  # whether the first scenes of a worker differ


@dataclass(frozen=True)
class Work:
    """Shards to forecast. `warm_ups`: the sum of `warm_up_share` over the workers that make them.

    `known`: the shards include those seen, which cost the same when they are made again.
    """

    shards: int
    scenes_per_shard: int
    warm_ups: float = 0.0
    known: bool = False

    @property
    def scenes(self) -> int:
        return self.shards * self.scenes_per_shard


def warm_up_share(before: float, scenes: float) -> float:
    """The share of a worker's warm-up that falls on `scenes` scenes after `before` others."""
    return math.exp(-before / WARM_UP_SCENES) - math.exp(-(before + scenes) / WARM_UP_SCENES)


@dataclass
class ShardCosts:
    """Sums over the costs of the shards seen, and draws of the costs of others. Constant memory."""

    variation: Variation
    seen: int = 0
    _fixed: float = 0.0
    _sums: F64 = field(default_factory=lambda: np.zeros(3))  # of scenes, warm-ups and costs without `fixed`
    _squares: F64 = field(default_factory=lambda: np.zeros((3, 3)))  # of the same, weighted

    def add(self, cost: float, scenes: int, before: int, fixed: float = 0.0) -> None:
        """Add a shard. `fixed` is the part of its cost that does not grow with its scenes."""
        share = warm_up_share(before, scenes) if self.variation.warms_up else 0.0
        row = np.array([scenes, share, max(cost - fixed, 0.0)])
        self.seen += 1
        self._fixed += fixed
        self._sums += row
        self._squares += np.outer(row, row) / scenes

    def total(self, work: Work) -> Draws:
        """Draws of the sum over the shards of `work`."""
        scene, warm_up, noise, rng = self._posterior()
        known_scenes, known_warm_ups, known = self._sums if work.known else np.zeros(3)
        unknown = max(work.scenes - known_scenes, 0.0)
        warm_ups = work.warm_ups - known_warm_ups if self.variation.warms_up else 0.0
        mean = scene * unknown + warm_up * warm_ups + known
        sums = mean + noise * math.sqrt(unknown) * rng.normal(size=N_DRAWS)
        sums = np.maximum(sums, known if unknown else 0.0) + work.shards * self._fixed / self.seen
        return sums * self._of_the_job(rng)

    def makespan(self, work: Work, workers: int, running: bool = False) -> Draws:
        """Draws of the time until the last shard of `work` ends, where the quantity is wall time.

        A worker that is free makes the next shard. `running`: each worker is at an unknown part of a shard.
        """
        scene, warm_up, noise, rng = self._posterior()
        mean = scene * work.scenes_per_shard + self._fixed / self.seen
        variance = noise**2 * work.scenes_per_shard
        workers = max(1, min(workers, work.shards))
        warm_up = np.maximum(warm_up, 0.0) * work.warm_ups / workers
        if work.shards <= 4 * workers <= 4 * _MOST_SCHEDULED:
            shards = _positive(rng, mean, variance, work.shards)
            if running:
                shards[:, :workers] *= rng.random((N_DRAWS, workers))
            ends, rows = np.repeat(warm_up[:, None], workers, axis=1), np.arange(N_DRAWS)
            for shard in shards.T:
                ends[rows, ends.argmin(axis=1)] += shard
            span = ends.max(axis=1)
        else:
            # When the last shard begins, each worker is at an unknown part of its own.
            whole = work.shards - 0.5 * workers * running
            begun = _positive(rng, whole * mean, whole * variance, 1)[:, 0] / workers
            left = _positive(rng, mean, variance, min(workers, _MOST_SCHEDULED))
            left *= rng.random(left.shape)
            span = warm_up + begun + left.max(axis=1) - left.mean(axis=1)
        return span * self._of_the_job(rng)

    def bound(self, work: Work) -> float:
        """The 90 % quantile of the sum over the shards of `work`."""
        return float(np.quantile(self.total(work), 0.9))

    def _posterior(self) -> tuple[Draws, Draws, Draws, np.random.Generator]:
        """Draws of a scene's cost, of a worker's warm-up, and of the noise of one scene."""
        rng = generator(0, Stream.FORECAST, self.seen)
        design, target = self._squares[:2, :2].copy(), self._squares[:2, 2]
        # The prior of the warm-up is one more row, in units of the noise.
        row = np.array([-_WARM_UP, 1.0]) * self.variation.scene / _WARM_UP_DEVIATION
        design += np.outer(row, row)
        inverse = np.linalg.inv(design)
        fit = inverse @ target
        left = max(float(self._squares[2, 2] - fit @ target), 0.0)  # sum of squared residuals
        freedom = _PRIOR_SHARDS + self.seen - 1
        # After a slow start the fit may count all cost as warm-up, but a scene has a cost too.
        least = max(_LEAST_SCENE * self._sums[2] / self._sums[0], 1e-12)
        prior = (self.variation.scene * max(fit[0], least)) ** 2
        variance = (_PRIOR_SHARDS * prior + left) / rng.chisquare(freedom, N_DRAWS)
        noise = np.sqrt(variance)
        off = rng.normal(size=(N_DRAWS, 2)) @ np.linalg.cholesky(inverse).T * noise[:, None]
        return np.maximum(fit[0] + off[:, 0], least), fit[1] + off[:, 1], noise, rng

    def _of_the_job(self, rng: np.random.Generator) -> Draws:
        return np.exp(rng.normal(0.0, self.variation.job, N_DRAWS))


def _positive(rng: np.random.Generator, mean: Draws, variance: Draws, columns: int) -> F64:
    """Log-normal draws of these means and variances, (N_DRAWS, columns).

    A sum of few skewed costs is about log-normal (Fenton and Wilkinson).
    """
    spread = np.log1p(variance / mean**2)
    location = np.log(mean) - spread / 2
    return np.exp(rng.normal(location[:, None], np.sqrt(spread)[:, None], (N_DRAWS, columns)))
