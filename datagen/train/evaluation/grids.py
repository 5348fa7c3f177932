"""Grids, and the best-scored candidate of each robot: its label, its distance to a positive, the ranking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from datagen.train.evaluation.columns import Columns
from datagen.train.evaluation.metrics import average_precision
from datagen.train.inputs import F64, Bools, Ints

# A grid is hard where at most this share of its clear cells is good.
HARD_SHARE = 0.2


def mixed_grids(columns: Columns) -> tuple[Bools, Bools]:
    """Masks (S,) of the scenes with good and bad clear cells, and of those of them that are hard."""
    clear = np.bincount(columns.scene, columns.is_clear, columns.n_scenes)
    good = np.bincount(columns.scene, columns.is_clear & columns.label, columns.n_scenes)
    both = (good > 0) & (good < clear)
    return both, both & (good <= HARD_SHARE * clear)


def picks(score: F64, group: Ints, allowed: Bools) -> F64:
    """Share (N,) of each group's choice: 1/k for its k best-scored allowed candidates, 0 for others."""
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


@dataclass(frozen=True, eq=False)
class Selection:
    """A method's choice in each of G groups.

    `good` is the share of positives among the best-scored candidates; `missed_m` the mean distance on the
    floor of the others to the nearest positive, 0 without others; `precision` the average precision of the
    allowed candidates in the order of their scores.
    """

    group: npt.NDArray[np.intp]  # (G,) those with an allowed candidate and a positive
    good: F64  # (G,)
    missed_m: F64  # (G,)
    precision: F64  # (G,)


def select(
    score: F64, true: Bools, base_xy_m: npt.NDArray[np.floating], group: Ints, allowed: Bools
) -> Selection:
    """The picks among allowed candidates (N,), over groups that have a positive among them."""
    rows = np.flatnonzero(allowed)
    rows = rows[np.argsort(group[rows], kind="stable")]
    found: list[tuple[float, ...]] = []
    for members in np.split(rows, np.flatnonzero(np.diff(group[rows])) + 1):
        good, scores = true[members], score[members]
        if not good.any():
            continue
        top = scores == scores.max()
        xy, missed = base_xy_m[members], top & ~good
        gaps_m = KDTree(xy[good]).query(xy[missed])[0] if missed.any() else np.zeros(1)
        precision = average_precision(good, scores)
        found.append((float(group[members[0]]), good[top].mean(), gaps_m.mean(), precision))
    columns = np.array(found, np.float64).reshape(-1, 4).T
    return Selection(columns[0].astype(np.intp), *columns[1:])
