"""Metrics of scores and decisions. Arrays are (N,); nan where undefined.

A decision is 0 or 1, or 1/k for each of k candidates with the same best score.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.train.inputs import F64, I64, Bools, Ints

N_BINS = 10


def confusion(decisions: F64, true: Bools, group: Ints, n_groups: int) -> F64:
    """True and false positives, false and true negatives (n_groups, 4) of decisions in [0, 1], by group."""
    parts = (decisions * true, decisions * ~true, (1 - decisions) * true, (1 - decisions) * ~true)
    return np.stack([np.bincount(group, part, n_groups) for part in parts], axis=1).astype(np.float64)


def accuracy(counts: F64) -> F64:
    """Accuracy (...) of confusions (..., 4)."""
    return ratio(counts[..., 0] + counts[..., 3], counts.sum(axis=-1))


def balanced_accuracy(counts: F64) -> F64:
    """Balanced accuracy (...), the mean of sensitivity and specificity, of confusions (..., 4)."""
    found = ratio(counts[..., 0], counts[..., 0] + counts[..., 2])
    refused = ratio(counts[..., 3], counts[..., 3] + counts[..., 1])
    return (found + refused) / 2


def ratio(part: F64, whole: F64) -> F64:
    """part / whole, nan where whole is 0."""
    return np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=whole > 0)


@dataclass(frozen=True, eq=False)
class Curve:
    """Points (K,) of a curve in order; equal scores give one point, since no threshold separates them."""

    x: F64
    y: F64

    def thinned(self, most: int) -> Curve:
        """At most `most` of the points, evenly along the curve, both ends among them."""
        if len(self.x) <= most:
            return self
        along = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(self.x)) + np.abs(np.diff(self.y)))])
        rows = np.unique(np.searchsorted(along, np.linspace(0, along[-1], most)).clip(max=len(along) - 1))
        rows[-1] = len(along) - 1
        return Curve(self.x[rows], self.y[rows])


def _steps(true: Bools, score: F64) -> tuple[F64, F64]:
    """True and false positives (K,) at thresholds of all distinct scores, the highest first."""
    order = np.argsort(-score, kind="stable")
    ordered = score[order]  # compared and not subtracted: scores may be infinite
    last_of_ties = np.flatnonzero(np.append(ordered[1:] != ordered[:-1], True))
    positives = np.cumsum(true[order])[last_of_ties]
    return positives.astype(np.float64), (last_of_ties + 1 - positives).astype(np.float64)


def roc(true: Bools, score: F64) -> Curve:
    """ROC curve: false (x) and true (y) positive rates. Needs both classes."""
    positives, negatives = _steps(true, score)
    return Curve(
        np.concatenate([[0.0], negatives / negatives[-1]]), np.concatenate([[0.0], positives / positives[-1]])
    )


def area_under_roc(true: Bools, score: F64) -> float:
    """Area under the ROC curve, ties counting half; nan with one class."""
    if not len(true) or true.all() or not true.any():
        return float("nan")
    curve = roc(true, score)
    return float(np.trapezoid(curve.y, curve.x))


def average_precision(true: Bools, score: F64) -> float:
    """Precision at each threshold, weighted by the recall it adds; nan without a positive."""
    if not true.any():
        return float("nan")
    positives, negatives = _steps(true, score)
    added = np.diff(positives / positives[-1], prepend=0.0)
    return float(np.sum(added * (positives / (positives + negatives))))


@dataclass(frozen=True, eq=False)
class Reliability:
    """Bins (K,) of predictions: count, mean prediction, observed rate."""

    count: I64
    predicted: F64
    true: F64

    @property
    def expected_error(self) -> float:
        """Expected calibration error: count-weighted distance of mean prediction and observed rate."""
        return float(np.average(np.abs(self.predicted - self.true), weights=self.count))


def reliability(true: Bools, probability: F64) -> Reliability:
    """Non-empty bins of [0, 1] of equal width; the last includes 1."""
    row = np.minimum((probability * N_BINS).astype(np.int64), N_BINS - 1)
    count = np.bincount(row, minlength=N_BINS)
    held = count > 0
    predicted, rate = (np.bincount(row, values, N_BINS)[held] / count[held] for values in (probability, true))
    return Reliability(count[held], predicted, rate)


def brier(true: Bools, probability: F64) -> float:
    """Brier score: mean squared difference of prediction and label."""
    return float(np.mean((probability - true) ** 2))
