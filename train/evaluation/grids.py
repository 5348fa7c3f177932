"""Choice of the best-scored candidate of each robot: its label, its distance to a positive, the order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.train.evaluation.metrics import average_precision
from datagen.train.inputs import F64, Bools, Ints


def picks(score: F64, group: Ints, allowed: Bools) -> F64:
    """Share (N,) of each group's choice: 1 for the best-scored allowed candidate, 0 for others.

    Of k candidates with the best score each has 1/k. A group without an allowed candidate has no choice.
    """
    share = np.zeros(len(score))
    rows = np.flatnonzero(allowed)
    if not len(rows):
        return share
    n_groups = int(group.max()) + 1
    best = np.full(n_groups, -np.inf)
    np.maximum.at(best, group[rows], score[rows])
    top = rows[score[rows] == best[group[rows]]]
    share[top] = 1 / np.bincount(group[top], minlength=n_groups)[group[top]]
    return share


def nearest_positive_m(base_xy_m: npt.NDArray[np.floating], true: Bools, group: Ints, asked: Bools) -> F64:
    """Distance (N,) on the floor from each asked candidate to the nearest positive of its group.

    nan for others, and where a group has no positive.
    """
    found = np.full(len(true), np.nan)
    asked_rows, positive_rows = np.flatnonzero(asked), np.flatnonzero(true)
    positives = positive_rows[np.argsort(group[positive_rows], kind="stable")]
    starts = np.searchsorted(group[positives], group[asked_rows], "left")
    ends = np.searchsorted(group[positives], group[asked_rows], "right")
    xy = base_xy_m.astype(np.float64)
    for row, start, end in zip(asked_rows, starts, ends, strict=True):
        if end > start:
            found[row] = np.linalg.norm(xy[positives[start:end]] - xy[row], axis=1).min()
    return found


@dataclass(frozen=True, eq=False)
class Selection:
    """What a method picked in each of G groups: its share of good picks, and how far the others missed.

    `missed_m` is the mean distance of the wrong picks, 0 where none was wrong. `precision` is the average
    precision of the allowed candidates in the order of their scores.
    """

    group: npt.NDArray[np.intp]  # (G,) those with an allowed candidate and a positive
    good: F64  # (G,)
    missed_m: F64  # (G,)
    precision: F64  # (G,)


def select(
    score: F64, true: Bools, base_xy_m: npt.NDArray[np.floating], group: Ints, allowed: Bools
) -> Selection:
    """The picks among allowed candidates (N,), over groups that have a positive among them."""
    n_groups = int(group.max(initial=-1)) + 1
    true = true & allowed
    counted = np.flatnonzero(np.bincount(group[true], minlength=n_groups))
    share = picks(score, group, allowed & np.isin(group, counted))
    picked = share > 0
    wrong = picked & ~true
    miss_m = np.where(wrong, nearest_positive_m(base_xy_m, true, group, wrong), 0.0)
    # All picks of a group have the same share, so that counts give exact ones.
    n, n_wrong = (np.bincount(group[rows], minlength=n_groups)[counted] for rows in (picked, wrong))
    sums_m = np.bincount(group, miss_m, n_groups)[counted]
    precision = np.array(
        [average_precision(true[rows], score[rows]) for rows in _rows_of(group, allowed, counted)]
    )
    return Selection(counted, (n - n_wrong) / n, sums_m / np.maximum(n_wrong, 1), precision)


def _rows_of(group: Ints, allowed: Bools, groups: npt.NDArray[np.intp]) -> list[npt.NDArray[np.intp]]:
    """The allowed candidates of each of these groups."""
    rows = np.flatnonzero(allowed)
    rows = rows[np.argsort(group[rows], kind="stable")]
    starts, ends = (np.searchsorted(group[rows], groups, side) for side in ("left", "right"))
    return [rows[start:end] for start, end in zip(starts, ends, strict=True)]
