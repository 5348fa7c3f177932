"""Evaluate methods on labels: every number of the tables with its interval, as plain values.

Values are None where undefined; intervals come from `datagen.train.bootstrap`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from datagen.evaluation.columns import Columns
from datagen.evaluation.comparisons import (
    SEED,
    Estimates,
    Method,
    by_recipe,
    comparisons,
    means_of,
)
from datagen.evaluation.grids import picks, select
from datagen.schemas.errors import InputError
from datagen.train import metrics
from datagen.train.bootstrap import (
    Estimate,
    Weights,
    resample_weights,
    resampled_area_under_roc,
    summed,
)
from datagen.train.inputs import F64, Bools

# In order of the report, which compares methods by each.
METRICS = ("accuracy", "balanced_accuracy", "area_under_roc", "best_pick", "mean_average_precision")
GRID_METRICS = ("good", "mean_average_precision")
_OF_CONFUSIONS = {"accuracy": metrics.accuracy, "balanced_accuracy": metrics.balanced_accuracy}


def evaluate_set(
    columns: Columns,
    methods: Sequence[Method],
    candidates: str,
    weights: Weights,
) -> dict[str, Any]:
    """Return the report of one candidate set; `weights` (B, S) resample the scenes of `columns`."""
    columns = columns.at(columns.is_in(candidates))
    n, positives = len(columns), int(columns.label.sum())
    if not n:
        fix = "Choose another set, or evaluate more scenes"
        raise InputError("--candidates", candidates, "has no candidate of these runs", fix)
    if positives in (0, n):
        problem = f"all {n:,} candidates have the label {int(positives > 0)}"
        raise InputError("--candidates", candidates, problem, "Evaluate a run with labels of both kinds")
    decisions = {m.name: _decisions(columns, m) for m in methods}
    estimates = {m.name: _estimates(columns, m, decisions[m.name], weights) for m in methods}
    return {
        "candidates": candidates,
        "count": n,
        "positives": positives,
        "scenes": len(np.unique(columns.scene)),
        "in_reach": _class_counts(columns, columns.is_reachable),
        "out_of_reach": _class_counts(columns, ~columns.is_reachable),
        "methods": {
            m.name: {
                **{name: e.values() for name, e in estimates[m.name].items()},
                **_calibration(columns, m),
            }
            for m in methods
        },
        **_over_seeds(estimates, methods, METRICS),
    }


def _decisions(columns: Columns, method: Method) -> F64:
    """Decisions (N,) in [0, 1], among exactly these candidates."""
    score = columns.scores[method.name]
    if method.only_picks:
        return picks(score, columns.robot, columns.is_clear)
    return (score >= method.threshold).astype(np.float64)


def _estimates(columns: Columns, method: Method, decisions: F64, weights: Weights) -> dict[str, Estimate]:
    score, true = columns.scores[method.name], columns.label

    def estimate(metric: Callable[[F64], F64], rows: Bools) -> Estimate:
        per_scene = metrics.confusion(decisions[rows], true[rows], columns.scene[rows], columns.n_scenes)
        return Estimate(float(metric(per_scene.sum(axis=0))), metric(summed(weights, per_scene)))

    everywhere, in_reach = np.ones(len(columns), np.bool_), columns.is_reachable
    area = metrics.area_under_roc(true, score)
    picked = _picked(columns, method, weights)
    return {
        **{name: estimate(metric, everywhere) for name, metric in _OF_CONFUSIONS.items()},
        "area_under_roc": Estimate(area, resampled_area_under_roc(weights, true, score, columns.scene)),
        "best_pick": picked["good"],
        "mean_average_precision": picked["mean_average_precision"],
        "accuracy_in_reach": estimate(metrics.accuracy, in_reach),
        "accuracy_out_of_reach": estimate(metrics.accuracy, ~in_reach),
    }


def _over_seeds(estimates: Estimates, methods: Sequence[Method], names: Sequence[str]) -> dict[str, Any]:
    """Means over trainings that differ by their seed alone, which stand for them in comparisons."""
    alike = by_recipe({m.name: m.recipe for m in methods})
    means = means_of(estimates, alike, np.random.default_rng([SEED, len(methods)]))
    origins = {m.name: m.origin for m in methods}
    origins |= {name: origins[members[0]] for name, members in alike.items()}
    averaged = {member for members in alike.values() for member in members}
    shown = {name: found for name, found in {**estimates, **means}.items() if name not in averaged}
    return {
        "means": [
            {"name": name, "of": alike[name], **{k: e.values() for k, e in of_metric.items()}}
            for name, of_metric in means.items()
        ],
        "comparisons": comparisons(shown, {name: origins[name] for name in shown}, names),
    }


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
        "methods": {name: {k: e.values() for k, e in found.items()} for name, found in estimates.items()},
        **_over_seeds(estimates, methods, GRID_METRICS),
    }


def _picked(columns: Columns, method: Method, weights: Weights) -> dict[str, Estimate]:
    """Means over robots with a good clear candidate: good picks, miss distance, average precision.

    `feasibility` is the area under the ROC curve of a scene's highest score of a clear candidate, as a
    predictor of whether any is good.
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

    def share(sums: F64, first: int) -> F64:
        return metrics.ratio(sums[..., first], sums[..., first + 1])

    trials = {"good": int((per_scene[:, 1] > 0).sum())}
    highest = np.full(columns.n_scenes, -np.inf)
    np.maximum.at(highest, columns.scene[columns.is_clear], score[columns.is_clear])
    offers = np.flatnonzero(np.isfinite(highest))
    feasible = np.bincount(columns.scene, columns.label & columns.is_clear, columns.n_scenes)[offers] > 0
    area = metrics.area_under_roc(feasible, highest[offers])
    drawn_area = resampled_area_under_roc(weights, feasible, highest[offers], offers)
    return {"feasibility": Estimate(area, drawn_area)} | {
        name: Estimate(float(share(whole, first)), share(drawn, first), trials.get(name, 0))
        for name, first in (("good", 0), ("missed_m", 2), ("mean_average_precision", 4))
    }


def weights_for(columns: Columns, n_resamples: int, seed: int) -> Weights:
    """The resamples of these scenes; the same for the same number of scenes and seed."""
    return resample_weights(columns.n_scenes, n_resamples, np.random.default_rng([seed, columns.n_scenes]))


def _calibration(columns: Columns, method: Method) -> dict[str, Any]:
    score, true = columns.scores[method.name], columns.label
    if not method.gives_probabilities:
        return {"brier": None, "expected_calibration_error": None}
    error = metrics.expected_calibration_error(true, score)
    return {"brier": metrics.brier(true, score), "expected_calibration_error": error}


def _class_counts(columns: Columns, rows: Bools) -> dict[str, int]:
    return {"count": int(rows.sum()), "positives": int(columns.label[rows].sum())}
