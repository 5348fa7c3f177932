"""Common parts of baselines: the interface, features, and fitting of a threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self
from weakref import WeakKeyDictionary

import numpy as np
from scipy.optimize import isotonic_regression

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, Array, Batch, Bools, is_clear
from datagen.train.observed_visibility import observed_visibility
from datagen.train.scorers import Scorer, scored

# Further columns of a batch that baselines need.
FIELDS = ("base_is_clear", "house_id")
# Penalty of impossible candidates, larger than any distance or probability.
RULED_OUT = 100.0


class Baseline(Scorer, Protocol):
    """A scorer without a network over clouds, possibly with a few fitted numbers."""

    @property
    def needs_fit(self) -> bool:
        """Whether it needs `fit` before it can score."""
        ...

    def fit(self, batches: Sequence[Batch[Array]]) -> Self:
        """Return a copy fitted to the labels. InputError where all labels are equal."""
        ...

    def state(self) -> dict[str, Any]:
        """Its fitted numbers as JSON values."""
        ...


class Unfitted:
    """Defaults of a baseline without parameters."""

    needs_fit = False

    def fit(self, batches: Sequence[Batch[Array]]) -> Self:
        return self

    def state(self) -> dict[str, Any]:
        return {}


def planar_distance_m(batch: Batch[Array]) -> F64:
    """Horizontal distance (N,) from each base to the target's centre (m)."""
    return np.linalg.norm(batch.candidates.base_xy_m.astype(np.float64), axis=1)


def mount_m(batch: Batch[Array]) -> F64:
    """Distance (N,) from each candidate's arm mount (x, y, base height) to the target's centre (m)."""
    robots = batch.robots
    rise_m = batch.clouds.target_height_m[robots.cloud_row] - robots.base_height_m.astype(np.float64)
    return np.hypot(planar_distance_m(batch), rise_m[batch.candidates.robot_row])


def reach_m(batch: Batch[Array]) -> F64:
    """Reach (N,) of each candidate's arm (m)."""
    return batch.robots.arm_reach_m[batch.candidates.robot_row].astype(np.float64)


def is_feasible(batch: Batch[Array]) -> Bools:
    """Mask (N,) of clear candidates within the arm's reach."""
    return is_clear(batch) & (mount_m(batch) <= reach_m(batch))


_KNOWN_RHO: WeakKeyDictionary[Batch[Array], F64] = WeakKeyDictionary()


def observed_rho(batch: Batch[Array]) -> F64:
    """Estimated rho (N,), cached for all baselines of a batch."""
    if batch not in _KNOWN_RHO:
        _KNOWN_RHO[batch] = observed_visibility(batch.clouds, batch.robots, batch.candidates)
    return _KNOWN_RHO[batch]


def labels(batches: Sequence[Batch[Array]], name: str) -> Bools:
    """All labels (N,). InputError where they are all equal, so that nothing can be fitted."""
    found = np.concatenate([np.zeros(0, np.int64), *(b.label for b in batches)]) == 1
    if found.all() or not found.any():
        problem = f"all {len(found):,} labels are equal, so nothing can be fitted"
        raise InputError(f"baseline {name}", "label", problem, "Fit on runs with labels of both kinds")
    return found


def best_cut(score: F64, label: Bools) -> float:
    """The lowest threshold on scores (N,) with the best balanced accuracy, midway between two scores."""
    order = np.argsort(score, kind="stable")
    s, y = score[order], label[order]
    # All rows from k on are positive.
    true_good = y.sum() - np.concatenate([[0], np.cumsum(y)])
    true_bad = np.concatenate([[0], np.cumsum(~y)])
    balanced = 0.5 * (true_good / y.sum() + true_bad / (~y).sum())
    allowed = np.concatenate([[True], s[1:] > s[:-1], [False]])
    k = int(np.argmax(np.where(allowed, balanced, -1)))
    return float(s[0]) if k == 0 else float((s[k - 1] + s[k]) / 2)


def refitted_cut(baseline: Scorer, batches: Sequence[Batch[Array]], threshold: float) -> float:
    """The best cut on scores of 0 or more of feasible candidates; `threshold` where these have one label.

    InputError where all labels are equal.
    """
    label = labels(batches, baseline.name)
    score = np.concatenate([np.where(is_feasible(b), scored(baseline, b), -1) for b in batches])
    kept = score >= 0
    same = label[kept].all() or not label[kept].any()
    return threshold if same else best_cut(score[kept], label[kept])


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
