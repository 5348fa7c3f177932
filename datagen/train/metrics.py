"""Metrics of scores and decisions. Arrays are (N,); nan where undefined.

A decision is 0 or 1, or 1/k for each of k candidates with the same best score.
"""

from __future__ import annotations

import numpy as np

from datagen.train.inputs import F64, Bools, Ints

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


def _steps(true: Bools, score: F64) -> tuple[F64, F64]:
    """True and false positives (K,) at thresholds of all distinct scores, the highest first."""
    order = np.argsort(-score, kind="stable")
    ordered = score[order]  # compared and not subtracted: scores may be infinite
    last_of_ties = np.flatnonzero(np.append(ordered[1:] != ordered[:-1], True))
    positives = np.cumsum(true[order])[last_of_ties]
    return positives.astype(np.float64), (last_of_ties + 1 - positives).astype(np.float64)


def area_under_roc(true: Bools, score: F64) -> float:
    """Area under the ROC curve, ties counting half; nan with one class."""
    if not len(true) or true.all() or not true.any():
        return float("nan")
    found, wrong = (np.append(0.0, count / count[-1]) for count in _steps(true, score))
    return float(np.trapezoid(found, wrong))


def average_precision(true: Bools, score: F64) -> float:
    """Precision at each threshold, weighted by the recall it adds; nan without a positive."""
    if not true.any():
        return float("nan")
    positives, negatives = _steps(true, score)
    added = np.diff(positives / positives[-1], prepend=0.0)
    return float(np.sum(added * (positives / (positives + negatives))))


def expected_calibration_error(true: Bools, probability: F64) -> float:
    """Mean distance of mean prediction and observed rate over equal bins, weighted by count."""
    row = np.minimum((probability * N_BINS).astype(np.int64), N_BINS - 1)
    said, seen = (np.bincount(row, values, N_BINS) for values in (probability, true))
    return float(np.abs(said - seen).sum() / len(true))


def brier(true: Bools, probability: F64) -> float:
    """Brier score: mean squared difference of prediction and label."""
    return float(np.mean((probability - true) ** 2))
