"""Picks: the best-scored candidate of each robot, and its success where the robot arrives with an error.

Truth between the cells of a grid is bilinear in the four labels around; it is 0 off the grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from datagen.evaluation.columns import Columns
from datagen.evaluation.comparisons import Method
from datagen.schemas.specification import DECISIVE_SHARES
from datagen.train.arrivals import Arrival, expected_success, ring_arrival, stands
from datagen.train.bootstrap import Estimate, Weights, summed
from datagen.train.inputs import F64, Bools, Ints
from datagen.train.metrics import average_precision, ratio

# Picks without a method: by the labels of the whole grid, and at random.
BY_LABELS, AT_RANDOM = "best by labels", "random in reach"
# Distances at which robots stop from the goal, in any direction.
DISTANCES_M = (0.0, 0.03, 0.05, 0.10, 0.15, 0.25)
PICKS = ("nominal", "smoothed")


def decisive_grids(columns: Columns) -> Bools:
    """Whether (S,) scenes are decisive: 5 to 60% of the clear cells in reach are good."""
    clear = np.bincount(columns.scene, columns.is_clear, columns.n_scenes)
    good = np.bincount(columns.scene, columns.is_clear & columns.label, columns.n_scenes)
    near = np.bincount(columns.scene, columns.is_in("in-range"), columns.n_scenes)
    good_near = np.bincount(columns.scene, columns.is_in("in-range") & columns.label, columns.n_scenes)
    low, high = DECISIVE_SHARES
    both = (good > 0) & (good < clear)
    return both & (good_near >= low * near) & (good_near <= high * near)


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


@dataclass(frozen=True, eq=False)
class GridMaps:
    """S whole grids as maps, rows along y and columns along x; `order` puts a scene's rows in their cells."""

    order: Ints  # (S, Y, X) rows of the columns
    truth: F64  # (S, Y, X)
    is_clear: Bools  # (S, Y, X)
    step_m: float


def grid_maps(columns: Columns) -> GridMaps | None:
    """The maps of columns whose scenes are all whole square grids of one spacing; None for others."""
    count = np.bincount(columns.scene, minlength=columns.n_scenes)
    side = round(float(np.sqrt(count[0]))) if len(count) else 0
    if side < 2 or (count != side**2).any():
        return None
    x, y = columns.base_xy_m.astype(np.float64).T
    wide_m = np.array([np.ptp(x[columns.scene == k]) for k in range(columns.n_scenes)])
    if np.ptp(wide_m) > 1e-3:
        return None
    step_m = float(wide_m.mean() / (side - 1))
    order = np.lexsort([np.round(x / step_m * 2), np.round(y / step_m * 2), columns.scene])
    order = order.reshape(columns.n_scenes, side, side)
    truth, is_clear = columns.label[order].astype(np.float64), columns.is_clear[order]
    return GridMaps(order, truth, is_clear, step_m)


def arrival_table(
    columns: Columns, methods: Sequence[Method], weights: Weights, given: Sequence[Arrival] = ()
) -> list[dict[str, Any]]:
    """Success of every method's picks for each arrival error: `DISTANCES_M` and those `given`.

    Only grids with a good clear cell are used; empty without any. A nominal pick is the cell with the best
    score, a smoothed pick that with the best mean probability over the error, where cells that are not clear
    are failures. Scores that are no probabilities are calibrated, or without a calibration replaced by their
    rank among a scene's clear cells. `best` is the highest success of a clear cell, `any` the mean over all.
    """
    maps = grid_maps(columns)
    if maps is None:
        return []
    some: Bools = np.any(maps.truth * maps.is_clear, axis=(1, 2), keepdims=True)[:, 0, 0]
    if not some.any():
        return []
    raw = {m.name: columns.scores[m.name][maps.order] for m in methods}
    chances = {m.name: method_values(raw[m.name], maps, m) for m in methods}
    found: list[dict[str, Any]] = []
    for arrival in [*map(ring_arrival, DISTANCES_M), *given]:
        truth = smoothed(maps.truth, maps, arrival)
        per_scene = {
            name: {
                "nominal": _picked(raw[name], truth, maps.is_clear),
                "smoothed": _picked(smoothed(chance, maps, arrival), truth, maps.is_clear),
            }
            for name, chance in chances.items()
        }
        offered = np.where(maps.is_clear, truth, np.nan)
        found.append(
            {
                "arrival": arrival.text,
                "best": float(np.nanmax(offered[some], axis=(1, 2)).mean()),
                "any": float(np.nanmean(offered[some], axis=(1, 2)).mean()),
                "methods": {
                    name: {
                        pick: mean_of_scenes(value, some, weights, int(some.sum())).values()
                        for pick, value in by_pick.items()
                    }
                    for name, by_pick in per_scene.items()
                },
            }
        )
    return found


def method_values(score: F64, maps: GridMaps, method: Method) -> F64:
    """Scores (S, Y, X) as chances in [0, 1], or ranks among the clear cells; 0 elsewhere."""
    if method.gives_probabilities:
        return stands(score, maps.is_clear)
    if method.chances is not None:
        return stands(method.chances(score), maps.is_clear)
    value = np.zeros(score.shape)
    for k, clear in enumerate(maps.is_clear):
        _, rank = np.unique(score[k][clear], return_inverse=True)
        value[k][clear] = (rank + 1) / (rank.max(initial=0) + 1)
    return value


def smoothed(value: F64, maps: GridMaps, arrival: Arrival) -> F64:
    """Maps (S, Y, X) of the mean value over the arrivals of a robot that is sent to each cell."""
    return np.stack([expected_success(each, maps.step_m, arrival) for each in value])


def _picked(value: F64, truth: F64, is_clear: Bools) -> F64:
    """Truth (S,) at each scene's best clear cell, the mean over equally good ones."""
    masked = np.where(is_clear, value, -np.inf)
    top = is_clear & (masked >= masked.max(axis=(1, 2), keepdims=True) - 1e-12)
    return (truth * top).sum(axis=(1, 2)) / np.maximum(top.sum(axis=(1, 2)), 1)


def mean_of_scenes(value: F64, some: Bools, weights: Weights, trials: int = 0) -> Estimate:
    """The mean of values (S,) over some of the scenes."""
    parts = np.column_stack([value, np.ones(len(value))]) * some[:, None]
    whole, drawn = parts.sum(axis=0), summed(weights, parts)
    return Estimate(float(ratio(whole[0], whole[1])), ratio(drawn[..., 0], drawn[..., 1]), trials)
