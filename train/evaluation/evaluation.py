"""Evaluate methods on labels: every number of the tables with its interval, as plain values.

Values are None where undefined; intervals come from `datagen.train.evaluation.bootstrap`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.evaluation import metrics
from datagen.train.evaluation.bootstrap import (
    Estimate,
    Weights,
    resample_weights,
    resampled_area_under_roc,
    summed,
)
from datagen.train.evaluation.breakdown import breakdown, groups_of
from datagen.train.evaluation.columns import Columns
from datagen.train.evaluation.comparisons import (
    NO_TRAINING,
    TrainedBy,
    comparisons,
    differences,
    finite,
    said_of,
)
from datagen.train.evaluation.grids import picks, select
from datagen.train.inputs import F64, Bools

_CURVE_POINTS = 200
# In order of the report, which has differences for each.
METRICS = ("accuracy", "balanced_accuracy", "area_under_roc", "best_pick", "mean_average_precision")
GRID_METRICS = ("good", "mean_average_precision")


@dataclass(frozen=True)
class Method:
    """A method: its name among the scores, and its training, which baselines lack.

    Scores in [0, 1] may or may not be probabilities, so this is a field.
    """

    name: str
    threshold: float
    origin: TrainedBy = NO_TRAINING
    says_probabilities: bool = False

    @property
    def only_picks(self) -> bool:
        """Whether it has no threshold, so that its choice among a robot's candidates is its decision."""
        return bool(np.isnan(self.threshold))

    def says(self, score: F64, columns: Columns) -> F64:
        """Its decisions (N,) in [0, 1], among exactly these candidates."""
        if self.only_picks:
            return picks(score, columns.robot, columns.is_clear)
        return (score >= self.threshold).astype(np.float64)


def evaluate_set(
    columns: Columns,
    methods: Sequence[Method],
    candidates: str,
    weights: Weights,
    trained_objects: Collection[str] = (),
) -> dict[str, Any]:
    """Return the report of one candidate set; `weights` (B, S) resample the scenes of `columns`.

    InputError where the set is empty, or its labels are all alike.
    """
    columns = columns.at(columns.is_in(candidates))
    n, positives = len(columns), int(columns.label.sum())
    if not n:
        fix = "Choose another set, or evaluate more scenes"
        raise InputError("--candidates", candidates, "has no candidate of these runs", fix)
    if positives in (0, n):
        problem = f"all {n:,} candidates have the label {int(positives > 0)}"
        raise InputError("--candidates", candidates, problem, "Evaluate a run with labels of both kinds")
    said = {m.name: m.says(columns.scores[m.name], columns) for m in methods}
    estimates = {m.name: _estimates(columns, m, said[m.name], weights) for m in methods}
    groups = groups_of(columns, trained_objects)
    return {
        "candidates": candidates,
        "count": n,
        "positives": positives,
        "scenes": len(np.unique(columns.scene)),
        "in_reach": _class_counts(columns, columns.is_reachable),
        "out_of_reach": _class_counts(columns, ~columns.is_reachable),
        "methods": {
            m.name: {
                **{name: said_of(e) for name, e in estimates[m.name].items()},
                **_calibration(columns, m),
            }
            for m in methods
        },
        "differences": differences(estimates, METRICS),
        "comparisons": comparisons(estimates, {m.name: m.origin for m in methods}, METRICS),
        "curves": {m.name: _curves(columns.label, columns.scores[m.name]) for m in methods},
        "breakdown": [
            {**row, "methods": {k: _plain(v) for k, v in row["methods"].items()}}
            for row in breakdown(groups, columns.label, said)
        ],
    }


def _estimates(columns: Columns, method: Method, said: F64, weights: Weights) -> dict[str, Estimate]:
    score, true = columns.scores[method.name], columns.label
    found: dict[str, Estimate] = {}

    def counted(rows: Bools) -> tuple[F64, F64]:
        per_scene = metrics.confusion(said[rows], true[rows], columns.scene[rows], columns.n_scenes)
        return per_scene.sum(axis=0), summed(weights, per_scene)

    whole, drawn = counted(np.ones(len(columns), np.bool_))
    found["accuracy"] = Estimate(float(metrics.accuracy(whole)), metrics.accuracy(drawn))
    found["balanced_accuracy"] = Estimate(
        float(metrics.balanced_accuracy(whole)), metrics.balanced_accuracy(drawn)
    )
    found["area_under_roc"] = Estimate(
        metrics.area_under_roc(true, score), resampled_area_under_roc(weights, true, score, columns.scene)
    )
    picked = _picked(columns, method, weights)
    found["best_pick"] = picked["good"]
    found["mean_average_precision"] = picked["mean_average_precision"]
    for name, rows in (("in_reach", columns.is_reachable), ("out_of_reach", ~columns.is_reachable)):
        whole, drawn = counted(rows)
        found[f"accuracy_{name}"] = Estimate(float(metrics.accuracy(whole)), metrics.accuracy(drawn))
    return found


def evaluate_grids(columns: Columns, methods: Sequence[Method], weights: Weights) -> dict[str, Any]:
    """Grid selection: the best clear candidate of each scene; all scenes of `columns` are whole grids."""
    clear = columns.is_clear
    positives = np.bincount(columns.scene, columns.label & clear, columns.n_scenes)
    offered = np.bincount(columns.scene, clear, columns.n_scenes)
    some = positives > 0
    estimates = {m.name: _picked(columns, m, weights) for m in methods}
    return {
        "scenes": columns.n_scenes,
        "scenes_without_positive": int((~some).sum()),
        "clear_per_scene": float(offered.mean()) if columns.n_scenes else None,
        "positives_per_scene": float(positives[some].mean()) if some.any() else None,
        "any_clear": float((positives[some] / offered[some]).mean()) if some.any() else None,
        "methods": {name: {k: said_of(e) for k, e in found.items()} for name, found in estimates.items()},
        "differences": differences(estimates, GRID_METRICS),
        "comparisons": comparisons(estimates, {m.name: m.origin for m in methods}, GRID_METRICS),
    }


def _picked(columns: Columns, method: Method, weights: Weights) -> dict[str, Estimate]:
    """What each robot with a good clear candidate is given, on average over such robots.

    The share of good picks, the mean distance of the others to the nearest good candidate, and the average
    precision of the order in which its clear candidates stand.
    """
    score = columns.scores[method.name]
    chosen = select(score, columns.label, columns.base_xy_m, columns.robot, columns.is_clear)
    scene_of = np.zeros(int(columns.robot.max(initial=-1)) + 1, np.int64)
    scene_of[columns.robot] = columns.scene
    wrong = 1 - chosen.good
    one = np.ones_like(wrong)
    parts = np.stack([chosen.good, one, wrong * chosen.missed_m, wrong, chosen.precision, one], axis=1)
    per_scene = np.zeros((columns.n_scenes, parts.shape[1]))
    np.add.at(per_scene, scene_of[chosen.group], parts)
    whole, drawn = per_scene.sum(axis=0), summed(weights, per_scene)
    trials = {"good": int((per_scene[:, 1] > 0).sum())}
    return {
        name: Estimate(float(_share(whole, first)), _share(drawn, first), trials.get(name, 0))
        for name, first in (("good", 0), ("missed_m", 2), ("mean_average_precision", 4))
    }


def _share(sums: F64, first: int) -> F64:
    part, whole = sums[..., first], sums[..., first + 1]
    return np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=whole > 0)


def weights_for(columns: Columns, n_resamples: int, seed: int) -> Weights:
    """The resamples of these scenes; the same for the same number of scenes and seed."""
    return resample_weights(columns.n_scenes, n_resamples, np.random.default_rng([seed, columns.n_scenes]))


def _calibration(columns: Columns, method: Method) -> dict[str, Any]:
    score, true = columns.scores[method.name], columns.label
    if not method.says_probabilities:
        return {"brier": None, "expected_calibration_error": None, "reliability": None}
    bins = metrics.reliability(true, score)
    rows = zip(bins.count.tolist(), bins.said.tolist(), bins.true.tolist(), strict=True)
    return {
        "brier": metrics.brier(true, score),
        "expected_calibration_error": bins.expected_error,
        "reliability": [{"count": c, "said": p, "true": t} for c, p, t in rows],
    }


def _curves(true: Bools, score: F64) -> dict[str, Any]:
    curves = {"roc": metrics.roc(true, score), "precision_recall": metrics.precision_recall(true, score)}
    thin = {name: curve.thinned(_CURVE_POINTS) for name, curve in curves.items()}
    return {
        "average_precision": metrics.average_precision(true, score),
        **{name: {"x": c.x.round(6).tolist(), "y": c.y.round(6).tolist()} for name, c in thin.items()},
    }


def _class_counts(columns: Columns, rows: Bools) -> dict[str, int]:
    return {"count": int(rows.sum()), "positives": int(columns.label[rows].sum())}


def _plain(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: finite(value) for name, value in values.items()}
