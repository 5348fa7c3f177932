"""The leaderboard as plain values: every method on every run, with intervals by scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from datagen import __version__
from datagen.benchmark.definition import Benchmark, BenchmarkRun
from datagen.evaluation_report.methods import EvaluatedMethod
from datagen.schemas.errors import InputError
from datagen.train.evaluation.arrival_success import arrival_table
from datagen.train.evaluation.bootstrap import LEVEL
from datagen.train.evaluation.columns import Columns, Gathered
from datagen.train.evaluation.evaluation import Method, evaluate_grids, evaluate_set, weights_for
from datagen.train.evaluation.grids import mixed_grids
from datagen.train.scorers import ModelScorer, weights_sha256

CANDIDATES = "in-range"
METRICS = ("balanced_accuracy", "area_under_roc", "accuracy")


def leaderboard(
    benchmark: Benchmark,
    runs: Mapping[str, BenchmarkRun],
    gathered: Gathered,
    methods: Sequence[EvaluatedMethod],
    fit: Sequence[str],
    resamples: int,
    seed: int,
) -> dict[str, Any]:
    """All numbers of the leaderboard; `gathered` has the runs in the order of `runs`.

    Runs of sampled candidates test decisions, runs of whole grids test picks. Undefined values are None.
    """
    judged = [each.method for each in methods]
    parts = {name: gathered.columns.of_scenes(gathered.columns.run == k) for k, name in enumerate(runs)}
    sampled = {name: part for name, part in parts.items() if not runs[name].is_of_grids}
    whole = {name: part for name, part in parts.items() if runs[name].is_of_grids}
    return {
        "benchmark": {
            "version": benchmark.version,
            "digest": benchmark.digest(),
            "runs": {
                name: {
                    "about": run.about,
                    "spec_hash": run.spec.hash(),
                    "digests": None if run.digests is None else run.digests.model_dump(),
                }
                for name, run in runs.items()
            },
            "not_scored": [name for name in benchmark.runs if name not in runs],
        },
        "datagen": __version__,
        "bootstrap": {"resamples": resamples, "seed": seed, "level": LEVEL, "by": "scene"},
        "fitted_on": [Path(path).name for path in fit],
        "methods": [_record(each, gathered) for each in methods],
        "candidates": {name: _decisions(part, judged, resamples, seed) for name, part in sampled.items()},
        "grids": {name: _picks(part, judged, resamples, seed) for name, part in whole.items()},
    }


def _record(method: EvaluatedMethod, gathered: Gathered) -> dict[str, Any]:
    """A method's entry. It names a checkpoint by its file name and digests, not by its path."""
    record = method.record()
    entry = {key: record[key] for key in ("name", "regime", "threshold", "note")}
    entry["seconds_per_600"] = gathered.seconds[method.name] * 600 / len(gathered.columns)
    checkpoint = record["checkpoint"]
    if checkpoint is not None:
        kept = ("sha256", "model", "config", "stage", "best_epoch")
        entry["checkpoint"] = {key: checkpoint[key] for key in kept}
        entry["checkpoint"]["file"] = Path(checkpoint["place"]).name
        assert isinstance(method.scorer, ModelScorer)
        entry["checkpoint"]["weights_sha256"] = weights_sha256(method.scorer.model)
    return entry


def _decisions(columns: Columns, methods: Sequence[Method], resamples: int, seed: int) -> dict[str, Any]:
    """Decisions on the candidates within reach: METRICS with intervals, and calibration."""
    weights = weights_for(columns, resamples, seed)
    scores = evaluate_set(columns, methods, CANDIDATES, weights, seed=seed)
    rate = scores["positives"] / scores["count"]
    kept = (*METRICS, "expected_calibration_error", "brier")
    return {
        "candidates": scores["count"],
        "scenes": scores["scenes"],
        "positive_rate": rate,
        "base_rate": max(rate, 1 - rate),
        "methods": {name: {key: values[key] for key in kept} for name, values in scores["methods"].items()},
        "means": [{key: mean[key] for key in ("name", "of", *METRICS)} for mean in scores["means"]],
        "differences": [
            d for d in scores["comparisons"] if d["kind"] == "best" and d["metric"] in METRICS[:2]
        ],
    }


def _picks(columns: Columns, methods: Sequence[Method], resamples: int, seed: int) -> dict[str, Any]:
    """Picks on whole grids with good and bad clear cells, and on the hard ones among them."""
    if not columns.is_grid.all():
        raise InputError("grids", "", "some scenes are no whole grid of one robot", "Make the run again")
    both, hard = mixed_grids(columns)
    found: dict[str, Any] = {"scenes": columns.n_scenes}
    for name, scenes in (("mixed", both), ("hard", hard)):
        part = columns.of_scenes(scenes)
        if not part.n_scenes:
            found[name] = None
            continue
        weights = weights_for(part, resamples, seed)
        scores = evaluate_grids(part, methods, weights, seed)
        found[name] = {
            **{key: scores[key] for key in ("scenes", "clear_per_scene", "positives_per_scene", "any_clear")},
            "methods": scores["methods"],
            "means": scores["means"],
            "arrivals": arrival_table(part, methods, weights),
        }
    return found
