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
_BLOCK = 64

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
    """The area under the ROC curve (B,) of each resample; nan in those of one class.

    It is a sum over pairs of scenes: how many positives of the one stand above negatives of the other, ties
    counting half. Positives are sorted once and the negatives of a scene at a time are looked up in
    them; of the pairs a block of columns is held.
    """
    b, n_scenes = weights.shape
    w = weights.astype(np.float64)
    order = np.argsort(score[true], kind="stable")
    positive_score, positive_scene = score[true][order], scene[true][order]
    by_scene = np.argsort(scene[~true], kind="stable")
    negative_score = score[~true][by_scene]
    n_negative = np.bincount(scene[~true], minlength=n_scenes)
    starts = np.concatenate([[0], np.cumsum(n_negative)])
    above = np.zeros(b)
    for first in range(0, n_scenes, _BLOCK):
        columns = range(first, min(first + _BLOCK, n_scenes))
        pairs = np.zeros((n_scenes, len(columns)))
        for k, j in enumerate(columns):
            negatives = negative_score[starts[j] : starts[j + 1]]
            if len(negatives) and len(positive_score):
                beaten = _beaten(positive_score, negatives)
                pairs[:, k] = np.bincount(positive_scene, beaten, n_scenes)
        above += np.sum((w @ pairs) * w[:, first : first + len(columns)], axis=1)
    of = (w @ np.bincount(scene[true], minlength=n_scenes)) * (w @ n_negative)
    return np.divide(above, of, out=np.full(b, np.nan), where=of > 0)


def _beaten(positives: F64, negatives: F64) -> F64:
    """How many negatives each of the sorted positives (P,) stands above, ties counting half."""
    n = len(positives)
    sides = (np.searchsorted(positives, negatives, side) for side in ("left", "right"))
    steps = sum(np.bincount(rows, minlength=n + 1)[:n] for rows in sides)
    return np.cumsum(steps) / 2


@dataclass(frozen=True, eq=False)
class Estimate:
    """A value with its resampled values (B,).

    `trials` is how many scenes a share is of, where it is one of scenes that each say yes or no.
    """

    value: float
    resamples: F64
    trials: int = 0

    def interval(self) -> tuple[float, float]:
        """The percentile interval of `LEVEL`; nan without defined resamples.

        Where all scenes of a share say yes, or all no, so does every resample, which is no certainty: then it
        is the exact interval of a share (Clopper and Pearson 1934).
        """
        said = self.resamples[np.isfinite(self.resamples)]
        if not len(said) or not np.isfinite(self.value):
            return float("nan"), float("nan")
        if self.trials and self.value in (0, 1):
            bound = ((1 - LEVEL) / 2) ** (1 / self.trials)
            return (bound, 1.0) if self.value else (0.0, 1 - bound)
        low, high = np.quantile(said, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        return float(low), float(high)

    def minus(self, other: Estimate) -> Estimate:
        """The difference, resample by resample."""
        return Estimate(self.value - other.value, self.resamples - other.resamples)


def verdict(difference: Estimate) -> str:
    """`above` or `below` where the interval of a difference excludes 0, else `open`."""
    low, high = difference.interval()
    if low > 0:
        return "above"
    return "below" if high < 0 else "open"


def are_disjoint(a: Estimate, b: Estimate) -> bool:
    """Whether the two intervals are disjoint, a stronger condition than a significant difference."""
    (a_low, a_high), (b_low, b_high) = a.interval(), b.interval()
    return a_low > b_high or b_low > a_high
