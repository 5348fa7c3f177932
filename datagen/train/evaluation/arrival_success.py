"""Success of each method's pick where the robot arrives with an error, on whole grids of labels.

Truth between cells is bilinear in the four labels around; it is 0 off the grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.train.arrivals import Arrival, expected_success, ring_arrival, stands
from datagen.train.evaluation import metrics
from datagen.train.evaluation.bootstrap import Estimate, Weights, summed
from datagen.train.evaluation.columns import Columns
from datagen.train.evaluation.comparisons import estimate_values
from datagen.train.evaluation.evaluation import Method
from datagen.train.inputs import F64, Bools, Ints

# Distances at which robots stop from the goal, in any direction.
DISTANCES_M = (0.0, 0.03, 0.05, 0.10, 0.15, 0.25)
PICKS = ("nominal", "smoothed")


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
    return GridMaps(order, columns.label[order].astype(np.float64), columns.is_clear[order], step_m)


def arrival_table(
    columns: Columns, methods: Sequence[Method], weights: Weights, given: Arrival | None = None
) -> list[dict[str, Any]]:
    """Success of every method's picks for each arrival error: `DISTANCES_M` and the `given` one.

    Only grids with a good clear cell are used; empty without any. A nominal pick is the cell with the best
    score, a smoothed pick that with the best mean probability over the error, where cells that are not clear
    are failures. Scores that are no probabilities are calibrated, or without a calibration replaced by their
    rank among a scene's clear cells. `best` is the highest success of a clear cell, `any` the mean over all.
    """
    maps = grid_maps(columns)
    if maps is None:
        return []
    some = np.flatnonzero((maps.truth * maps.is_clear).any(axis=(1, 2)))
    if not len(some):
        return []
    raw = {m.name: columns.scores[m.name][maps.order] for m in methods}
    chances = {m.name: method_values(raw[m.name], maps, m) for m in methods}
    found: list[dict[str, Any]] = []
    for arrival in [*map(ring_arrival, DISTANCES_M), *([given] if given else [])]:
        truth = smoothed(maps.truth, maps.step_m, arrival)
        per_scene = {
            name: {
                "nominal": _picked(raw[name], truth, maps.is_clear),
                "smoothed": _picked(smoothed(chance, maps.step_m, arrival), truth, maps.is_clear),
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
                        pick: estimate_values(_mean(value, some, weights)) for pick, value in picks.items()
                    }
                    for name, picks in per_scene.items()
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


def smoothed(value: F64, step_m: float, arrival: Arrival) -> F64:
    """Maps (S, Y, X) of the mean value over the arrivals of a robot that is sent to each cell."""
    return np.stack([expected_success(each, step_m, arrival) for each in value])


def _picked(value: F64, truth: F64, is_clear: Bools) -> F64:
    """Truth (S,) at each scene's best clear cell, the mean over equally good ones."""
    masked = np.where(is_clear, value, -np.inf)
    top = is_clear & (masked >= masked.max(axis=(1, 2), keepdims=True) - 1e-12)
    return (truth * top).sum(axis=(1, 2)) / np.maximum(top.sum(axis=(1, 2)), 1)


def _mean(value: F64, some: Any, weights: Weights) -> Estimate:
    parts = np.zeros((len(value), 2))
    parts[some] = np.column_stack([value[some], np.ones(len(some))])
    whole, drawn = parts.sum(axis=0), summed(weights, parts)
    return Estimate(float(metrics.ratio(whole[0], whole[1])), metrics.ratio(drawn[..., 0], drawn[..., 1]))
