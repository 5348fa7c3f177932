"""Rates from many cheap and few dear labels, with scenes as units.

The estimator is that of prediction-powered inference with a tuned coefficient (Angelopoulos, Duchi, Zrnic,
"PPI++", arXiv 2311.01453), which for means is the regression estimator of two-phase sampling (Cochran 1977,
ch. 12): the rate of the dear labels, corrected by how far the cheap labels of the same candidates lie from
those of the whole population. Dear labels count 1/probability where they were selected (Hajek's estimator).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from datagen.train.inputs import F64, I64, Bools

LEVEL = 0.95
# A difference to the population below this share of its variance between scenes counts as none.
_NO_DIFFERENCE = 1e-9
# Scenes with dear labels for each cheap column: with fewer, a coefficient raises the variance.
_SCENES_A_COLUMN = 20


@dataclass(frozen=True, eq=False)
class Population:
    """N candidates of M scenes; scenes are numbered from 0, each has a row.

    `cheap` has a column for each of P cheap sources. `probability` is that with which a candidate was
    selected for a dear label, the scene's included. It and `label` are undefined where `is_dear` is false.
    """

    n_scenes: int
    scene: I64  # (N,)
    cheap: F64  # (N, P)
    is_dear: Bools  # (N,)
    label: Bools  # (N,)
    probability: F64  # (N,)


@dataclass(frozen=True)
class Interval:
    """A rate with its variance and its interval of `LEVEL`."""

    rate: float
    variance: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        return (self.high - self.low) / 2


@dataclass(frozen=True)
class RateEstimate:
    """The rate of the dear labels in a population, from all labels and from the dear ones alone.

    `weights` are the coefficients of the cheap columns. The variance is `dear_part` / `dear_scenes` plus
    `cheap_part`, which more dear labels do not reduce.
    """

    mixed: Interval
    dear_alone: Interval
    weights: tuple[float, ...]
    candidates: float  # in the population
    dear_labels: int  # of these
    dear_scenes: int  # with any dear label, in the population or not
    scenes: int
    dear_part: float
    cheap_part: float

    @property
    def effective_labels(self) -> float:
        """Number of dear labels that would give this variance without cheap ones."""
        if self.mixed.variance == 0:
            return float(self.dear_labels)
        return self.dear_labels * self.dear_alone.variance / self.mixed.variance

    def growth(self, half_width: float) -> float:
        """Factor, at least 1, by which the number of dear labels must grow for this half width.

        inf where the cheap labels' part of the variance alone is too large.
        """
        wanted = float(half_width / stats.norm.ppf((1 + LEVEL) / 2)) ** 2
        if wanted <= self.cheap_part:
            return float("inf")
        return max(1.0, self.dear_part / (wanted - self.cheap_part) / self.dear_scenes)


def estimate_rate(population: Population, member: F64) -> RateEstimate | None:
    """Estimate the share of dear positives among the candidates, each counted `member` (N,) times.

    `member` is 0 or 1 for a set of candidates, or a share where a choice among candidates is tied. None where
    fewer than three scenes have a dear label of a candidate that counts.
    """
    counts = _Counts.of(population, member)
    scenes, filled = len(counts.dear_scenes), int(np.count_nonzero(counts.dear_n))
    if filled < 3:
        return None
    rate = float(counts.dear_positives.sum() / counts.dear_n.sum())
    cheap_all = counts.cheap.sum(axis=0) / counts.n.sum()
    cheap_dear = counts.dear_cheap.sum(axis=0) / counts.dear_n.sum()
    # Linearized ratios (Cochran 1977, sec. 6.4): each is a sum over scenes with mean 0.
    total = counts.dear_n.sum()
    y = (counts.dear_positives - rate * counts.dear_n) / total
    x = (counts.dear_cheap - counts.dear_n[:, None] * cheap_dear) / total
    x_all = (counts.cheap - counts.n[:, None] * cheap_all) / counts.n.sum()
    # Variances between scenes: of the dear phase, and of the population as a sample of all scenes.
    between = scenes / (scenes - 1)
    y_y, y_x, x_x = between * (y @ y), between * (x.T @ y), between * (x.T @ x)
    whole = population.n_scenes / max(population.n_scenes - 1, 1)
    y_x_all = whole * (x_all[counts.dear_scenes].T @ y)
    x_x_all = whole * (x_all.T @ x_all)
    weights = _weights(x_x - x_x_all, y_x - y_x_all, x_x, filled // _SCENES_A_COLUMN)
    used = int(np.count_nonzero(weights))
    residual = y_y - 2 * weights @ y_x + weights @ x_x @ weights
    residual *= (filled - 1) / (filled - 1 - used)
    cheap_part = max(0.0, float(2 * weights @ y_x_all - weights @ x_x_all @ weights))
    mixed = float(rate + weights @ (cheap_all - cheap_dear))
    return RateEstimate(
        mixed=_interval(mixed, float(residual) + cheap_part, filled - 1 - used, filled),
        dear_alone=_interval(rate, float(y_y), filled - 1, filled),
        weights=tuple(weights.tolist()),
        candidates=float(counts.n.sum()),
        dear_labels=counts.dear_labels,
        dear_scenes=scenes,
        scenes=population.n_scenes,
        dear_part=float(residual) * scenes,
        cheap_part=cheap_part,
    )


@dataclass(frozen=True, eq=False)
class _Counts:
    """Sums over scenes: of all M, and, each label counted 1/probability, of the m with dear labels."""

    n: F64  # (M,)
    cheap: F64  # (M, P)
    dear_scenes: I64  # (m,) rows among the M
    dear_n: F64  # (m,)
    dear_cheap: F64  # (m, P)
    dear_positives: F64  # (m,)
    dear_labels: int

    @classmethod
    def of(cls, population: Population, member: F64) -> _Counts:
        scene, size = population.scene, population.n_scenes
        dear = np.flatnonzero(population.is_dear)
        weight = member[dear] / population.probability[dear]
        dear_scenes, row = np.unique(scene[dear], return_inverse=True)

        def summed(of: npt.NDArray[np.integer], values: F64, rows: int) -> F64:
            return np.bincount(of, values, rows).astype(np.float64, copy=False)

        columns = population.cheap.T
        return cls(
            n=summed(scene, member, size),
            cheap=np.stack([summed(scene, member * column, size) for column in columns], axis=1),
            dear_scenes=dear_scenes,
            dear_n=summed(row, weight, len(dear_scenes)),
            dear_cheap=np.stack(
                [summed(row, weight * column[dear], len(dear_scenes)) for column in columns], axis=1
            ),
            dear_positives=summed(row, weight * population.label[dear], len(dear_scenes)),
            dear_labels=int(np.count_nonzero(member[dear])),
        )


def _weights(differences: F64, with_dear: F64, between: F64, most: int) -> F64:
    """Coefficients (P,) of least variance, `most` of them not 0.

    `differences` (P, P) is the variance of the cheap rates' difference between the dear labels and the whole
    population, `with_dear` (P,) its covariance with the dear rate. A column that does not vary, or that the
    others explain, has the coefficient 0; all are 0 where all candidates have dear labels.
    """
    kept: list[int] = []
    for column in range(len(with_dear)):
        tried = [*kept, column]
        part, size = differences[np.ix_(tried, tried)], between.diagonal()[tried]
        if len(kept) == most or (size <= 0).any():
            continue
        scaled = part / np.sqrt(np.outer(size, size))
        if np.linalg.eigvalsh(scaled).min() > max(_NO_DIFFERENCE, 1e-6 * len(tried)):
            kept = tried
    weights = np.zeros(len(with_dear))
    if kept:
        weights[kept] = np.linalg.solve(differences[np.ix_(kept, kept)], with_dear[kept])
    return weights


def _interval(rate: float, variance: float, freedom: int, scenes: int) -> Interval:
    """The interval by Student's t on the logit scale, so that it stays within 0 and 1.

    Without variance, at a rate of 0 or 1: the exact interval of as many trials as scenes (Clopper, Pearson).
    """
    if variance > 0 and 0 < rate < 1:
        spread = stats.t.ppf((1 + LEVEL) / 2, freedom) * np.sqrt(variance) / (rate * (1 - rate))
        low, high = (float(1 / (1 + np.exp(-np.log(rate / (1 - rate)) - side * spread))) for side in (-1, 1))
        return Interval(rate, variance, low, high)
    if 0 < rate < 1:
        return Interval(rate, 0.0, rate, rate)
    bound = ((1 - LEVEL) / 2) ** (1 / scenes)
    low, high = (bound, 1.0) if rate >= 1 else (0.0, 1 - bound)
    return Interval(min(max(rate, 0.0), 1.0), max(variance, 0.0), low, high)
