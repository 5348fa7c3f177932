"""Robust z-scores: how far values lie from the median of their kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# Values with a larger score count as outliers, and fewer values have no scores.
THRESHOLD, FEWEST = 3.5, 8


@dataclass(frozen=True, eq=False)
class Measure:
    """A quantity of K shards or scenes: `values` (K,), nan where it is not known.

    Scores are of `scale(values)`, on which the quantity varies evenly. Shares have the unit "%" and lie
    between 0 and 1.
    """

    name: str
    values: F64
    scale: Callable[[F64], F64]
    unit: str = ""

    def text(self, value: float) -> str:
        """A value for people, with its unit."""
        if self.unit == "%":
            return f"{100 * value:.1f}%"
        number = f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
        return f"{number} {self.unit}".rstrip()

    @property
    def median(self) -> float:
        """The median of the known values; nan without any."""
        known = self.values[np.isfinite(self.values)]
        return float(np.median(known)) if len(known) else float("nan")

    @property
    def varies(self) -> bool:
        """Whether two known values differ."""
        return len(np.unique(self.values[np.isfinite(self.values)])) > 1

    @property
    def scores(self) -> F64:
        """Robust z-scores (K,)."""
        return robust_z(self.scale(self.values))


@dataclass(frozen=True)
class Outlier:
    """A value that stands out: its row, its measure, and its score."""

    row: int
    measure: str
    value: float
    score: float


def robust_z(values: F64) -> F64:
    """Modified z-scores (K,): (x - median) / (1.4826 MAD), or / (1.2533 MeanAD) where the MAD is 0.

    Zero for unknown values, where all are equal, and among fewer than `FEWEST` values. Source: Iglewicz and
    Hoaglin, How to Detect and Handle Outliers, 1993, who call scores above 3.5 potential outliers.
    """
    known = np.isfinite(values)
    score = np.zeros(len(values))
    if known.sum() < FEWEST:
        return score
    off = values[known] - np.median(values[known])
    spread = 1.4826 * float(np.median(np.abs(off))) or 1.2533 * float(np.mean(np.abs(off)))
    if spread > 0:
        score[known] = off / spread
    return score


def outliers_of(measures: Sequence[Measure]) -> list[Outlier]:
    """Every value beyond the threshold, the largest score first."""
    found = [
        Outlier(row, m.name, float(m.values[row]), float(scores[row]))
        for m in measures
        for scores in [m.scores]
        for row in np.flatnonzero(np.abs(scores) > THRESHOLD).tolist()
    ]
    return sorted(found, key=lambda o: (-abs(o.score), o.row, o.measure))


def most_unusual(measures: Sequence[Measure], count: int, most_each: int) -> list[tuple[int, Outlier]]:
    """Rows by their largest score, each with the value that has this score, the largest first.

    At most `most_each` rows for one measure, so that one odd quantity does not fill the list.
    """
    scores = np.stack([m.scores for m in measures])
    which, largest = np.abs(scores).argmax(axis=0), np.abs(scores).max(axis=0)
    chosen: list[tuple[int, Outlier]] = []
    used = dict.fromkeys(range(len(measures)), 0)
    for row in np.lexsort([np.arange(len(largest)), -largest]).tolist():
        k = int(which[row])
        if used[k] >= most_each:
            continue
        used[k] += 1
        measure = measures[k]
        chosen.append((row, Outlier(row, measure.name, float(measure.values[row]), float(scores[k, row]))))
        if len(chosen) == count:
            break
    return chosen


def arcsine(share: F64) -> F64:
    """arcsin of the square root: shares vary evenly on it, also near 0 and 1."""
    return np.arcsin(np.sqrt(np.clip(share, 0, 1)))


def log(values: F64) -> F64:
    """The logarithm of positive values; nan for others."""
    return np.log(np.where(values > 0, values, np.nan))
