"""Probabilities of success from scores of any scale, by isotonic regression on labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

from datagen.train.baselines.baseline import Baseline, labels
from datagen.train.inputs import F64, Array, Batch, is_clear
from datagen.train.scorers import scored


@dataclass(frozen=True, eq=False)
class Calibration:
    """A probability that never falls with the score: linear between knots, constant beyond them."""

    score: F64  # (K,), rising
    chance: F64  # (K,), in [0, 1]

    def __call__(self, score: F64) -> F64:
        """Probabilities of scores, in their shape."""
        return np.interp(score, self.score, self.chance)


def calibrate(baseline: Baseline, batches: Sequence[Batch[Array]]) -> Calibration:
    """Calibration of a fitted baseline on clear candidates; equal scores get their mean label.

    InputError where all labels are equal.
    """
    clear = np.concatenate([is_clear(b) for b in batches])
    score = np.concatenate([scored(baseline, b) for b in batches])[clear]
    good = labels(batches, baseline.name)[clear].astype(np.float64)
    knots, at = np.unique(score, return_inverse=True)
    count = np.bincount(at)
    found = isotonic_regression(np.bincount(at, good) / count, weights=count)
    ends = found.blocks
    # A knot in the middle of each block, so that a better score has a higher chance between blocks.
    middle = np.add.reduceat(knots * count, ends[:-1]) / np.add.reduceat(count, ends[:-1])
    return Calibration(middle, found.x[ends[:-1]])
