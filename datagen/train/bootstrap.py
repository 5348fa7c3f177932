"""Intervals by resampling scenes, since candidates of one scene are correlated.

Every statistic is a function of sums over scenes, so a resample is a weight per scene, and a thousand of
them are one matrix product. All methods share the resamples, which makes paired differences precise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.train.inputs import F64, Bools, Ints

LEVEL = 0.95

Weights = npt.NDArray[np.uint16]


def resample_weights(n_scenes: int, n_resamples: int, rng: np.random.Generator) -> Weights:
    """Counts (B, S) of each scene in each resample."""
    drawn = np.empty((n_resamples, n_scenes), np.uint16)
    for row in drawn:
        row[:] = np.bincount(rng.integers(0, n_scenes, n_scenes), minlength=n_scenes)
    return drawn


def summed(weights: Weights, per_scene: F64) -> F64:
    """Sums (B, ...) over the resampled scenes of values per scene (S, ...)."""
    return weights.astype(np.float64) @ per_scene


def resampled_area_under_roc(weights: Weights, true: Bools, score: F64, scene: Ints) -> F64:
    """The area under the ROC curve (B,) of each resample, ties counting half; nan with one class."""
    _, rank = np.unique(score, return_inverse=True)
    found = np.full(len(weights), np.nan)
    for k, of_scene in enumerate(weights.astype(np.float64)):
        weight = of_scene[scene]
        positive, negative = (np.bincount(rank, weight * rows) for rows in (true, ~true))
        pairs = positive.sum() * negative.sum()
        if pairs:
            found[k] = positive @ (np.cumsum(negative) - negative / 2) / pairs
    return found


@dataclass(frozen=True, eq=False)
class Estimate:
    """A value with its resampled values (B,); `trials` is the number of scenes of a share of scenes."""

    value: float
    resamples: F64
    trials: int = 0

    def interval(self) -> tuple[float, float]:
        """The percentile interval of `LEVEL`; nan without defined resamples.

        A share of scenes that is 0 or 1 has the exact interval (Clopper and Pearson 1934).
        """
        defined = self.resamples[np.isfinite(self.resamples)]
        if not len(defined) or not np.isfinite(self.value):
            return float("nan"), float("nan")
        if self.trials and self.value in (0, 1):
            bound = ((1 - LEVEL) / 2) ** (1 / self.trials)
            return (bound, 1.0) if self.value else (0.0, 1 - bound)
        low, high = np.quantile(defined, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        return float(low), float(high)

    def minus(self, other: Estimate) -> Estimate:
        """The difference, resample by resample."""
        return Estimate(self.value - other.value, self.resamples - other.resamples)

    def values(self) -> dict[str, float | None]:
        """Value and interval as JSON values, None for nan."""
        low, high = self.interval()
        return {"value": finite(self.value), "low": finite(low), "high": finite(high)}


def finite(value: float) -> float | None:
    """None for nan."""
    return value if np.isfinite(value) else None


def verdict(difference: Estimate) -> str:
    """`above` or `below` where the interval of a difference excludes 0, else `open`."""
    low, high = difference.interval()
    if low > 0:
        return "above"
    return "below" if high < 0 else "open"
