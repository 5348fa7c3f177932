"""Choices and success rates of a closed loop: which cells methods pick, and where robots arrive.

`datagen.closed_loop` plans and executes the trials after an arrival.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from datagen.train.arrivals import Arrival
from datagen.train.evaluation.arrival_success import PICKS, GridMaps, method_values, smoothed
from datagen.train.evaluation.bootstrap import Estimate, Weights, summed
from datagen.train.evaluation.columns import Columns
from datagen.train.evaluation.comparisons import TrainedBy, comparisons, estimate_values
from datagen.train.evaluation.evaluation import Method
from datagen.train.inputs import F64, I64, Bools

# Picks without a method: by the labels of the whole grid, and at random.
BY_LABELS, AT_RANDOM = "best by labels", "random in reach"

Pick = tuple[str, str]  # a method, and one of PICKS
Names = npt.NDArray[np.object_]


@dataclass(frozen=True, eq=False)
class Turns:
    """E arrival errors in S scenes, D arrivals each: the picks, and the errors of the arrivals."""

    cells: Mapping[Pick, I64]  # (E, S) each, index into Y * X cells
    offsets: F64  # (E, S, D, 3), in the frame of the goal: x ahead, y to the left (m), yaw (rad)


def plan_turns(
    columns: Columns,
    maps: GridMaps,
    methods: Sequence[Method],
    arrivals: Sequence[Arrival],
    n: int,
    generators: Callable[[int, int], np.random.Generator],
) -> Turns:
    """The picks of every method and `n` arrivals a scene.

    A nominal pick is the clear cell with the best score, a smoothed one that with the best mean of the score
    over the error (as `arrival_table`). Ties are broken at random, the same for all methods.
    `generators(scene, purpose)` gives each scene's own; arrivals of all errors use the same state, so that
    they have the same directions.
    """
    side = maps.truth.shape[1:]
    lucky = np.stack([generators(k, 0).random((2, *side)) for k in range(columns.n_scenes)])

    def best(value: F64, luck: F64 = lucky[:, 0]) -> I64:
        masked = np.where(maps.is_clear, value, -np.inf)
        top = masked >= masked.max(axis=(1, 2), keepdims=True) - 1e-12
        return np.where(top & maps.is_clear, luck, -1.0).reshape(len(luck), -1).argmax(axis=1)

    raw = {m.name: columns.scores[m.name][maps.order] for m in methods} | {BY_LABELS: maps.truth}
    values = {m.name: method_values(raw[m.name], maps, m) for m in methods} | {BY_LABELS: maps.truth}
    cells: dict[Pick, I64] = {}
    for name, score in raw.items():
        cells[name, "nominal"] = np.stack([best(score)] * len(arrivals))
        cells[name, "smoothed"] = np.stack(
            [best(smoothed(values[name], maps.step_m, arrival)) for arrival in arrivals]
        )
    within = best(columns.is_reachable[maps.order].astype(np.float64), lucky[:, 1])
    cells[AT_RANDOM, "nominal"] = np.stack([within] * len(arrivals))
    offsets = [[arrival.drawn(n, generators(k, 1)) for k in range(columns.n_scenes)] for arrival in arrivals]
    # Rounded, and without -0: its numbers identify an arrival.
    return Turns(cells, np.round(np.array(offsets), 6) + 0.0)


def candidates_of(maps: GridMaps, cells: I64) -> I64:
    """Index (E, S), within its scene, of the candidate in each cell (E, S)."""
    rows = maps.order.reshape(len(maps.order), -1)
    return rows[np.arange(len(rows)), cells] - rows.min(axis=1)


def label_success(columns: Columns, maps: GridMaps, cells: I64, offsets: F64) -> tuple[F64, F64]:
    """Success (E, S, D) of each arrival by the labels around it: of the nearest cell, and bilinear.

    It is 0 off the grid.
    """
    scene = np.arange(len(maps.order))
    xy = columns.base_xy_m.astype(np.float64)[maps.order.reshape(len(scene), -1)]  # (S, Y * X, 2)
    goal = xy[scene, cells][:, :, None]  # (E, S, 1, 2), which faces the target at the origin
    yaw = np.arctan2(-goal[..., 1], -goal[..., 0])
    x = goal[..., 0] + np.cos(yaw) * offsets[..., 0] - np.sin(yaw) * offsets[..., 1] - xy[:, 0, 0][:, None]
    y = goal[..., 1] + np.sin(yaw) * offsets[..., 0] + np.cos(yaw) * offsets[..., 1] - xy[:, 0, 1][:, None]
    where = [np.broadcast_to(scene[:, None], x.shape).astype(np.float64), y / maps.step_m, x / maps.step_m]
    nearest, bilinear = (
        np.asarray(ndimage.map_coordinates(maps.truth, where, order=order, mode="constant"), np.float64)
        for order in (0, 1)
    )
    return nearest, bilinear


def loop_table(
    outcomes: Mapping[Pick, Names],
    by_labels: Mapping[Pick, F64],
    arrivals: Sequence[Arrival],
    origins: Mapping[str, TrainedBy],
    scenes: Bools,
    weights: Weights,
) -> list[dict[str, Any]]:
    """Success of every pick for each arrival error over some of the S scenes, with intervals over scenes.

    `outcomes` are keys of OUTCOMES, `by_labels` success by labels (E, S, D); `weights` (B, S) resample the
    scenes. `gains` are paired differences of smoothed and nominal picks, `comparisons` those of methods'
    smoothed picks.
    """
    found: list[dict[str, Any]] = []
    for e, arrival in enumerate(arrivals):
        rates: dict[str, dict[str, Estimate]] = {}
        results: dict[str, dict[str, Any]] = {}
        for (name, pick), of_pick in outcomes.items():
            ends = of_pick[e, scenes]
            rates.setdefault(name, {})[pick] = rate = _rate(of_pick[e] == "success", scenes, weights)
            causes, count = np.unique(ends[ends != "success"].astype(str), return_counts=True)
            shares = sorted(zip((count / ends.size).tolist(), causes.tolist(), strict=True), reverse=True)
            results.setdefault(name, {})[pick] = {
                **estimate_values(rate),
                "by_labels": float(by_labels[name, pick][e, scenes].mean()),
                "failures": {cause: share for share, cause in shares},
            }
        methods = {name: rates[name] for name in origins}
        found.append(
            {
                "arrival": arrival.text,
                "distance_m": arrival.distance_m,
                "yaw_std_rad": arrival.yaw_std_rad,
                "methods": results,
                "gains": {
                    name: estimate_values(by_pick["smoothed"].minus(by_pick["nominal"]))
                    for name, by_pick in rates.items()
                    if len(by_pick) == len(PICKS)
                },
                "comparisons": comparisons(methods, origins, ("smoothed",)),
            }
        )
    return found


def _rate(success: npt.NDArray[Any], scenes: Bools, weights: Weights) -> Estimate:
    """The mean over scenes of each scene's share (S, D) of successes."""
    parts = np.column_stack([success.mean(axis=1), np.ones(len(success))]) * scenes[:, None]
    whole, drawn = parts.sum(axis=0), summed(weights, parts)
    with np.errstate(invalid="ignore"):  # a resample of few scenes may hold none of these
        return Estimate(float(whole[0] / whole[1]), drawn[:, 0] / drawn[:, 1], int(scenes.sum()))
