"""The evaluation as plain values: methods, runs, and every number with its interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from datagen import __version__
from datagen.evaluation_report.evaluated_runs import EvaluatedRun
from datagen.evaluation_report.methods import BaselineMethods, EvaluatedMethod
from datagen.schemas.errors import InputError
from datagen.train.arrivals import Arrival
from datagen.train.evaluation import paper_results
from datagen.train.evaluation.arrival_success import arrival_table
from datagen.train.evaluation.bootstrap import LEVEL
from datagen.train.evaluation.columns import Columns, Gathered
from datagen.train.evaluation.evaluation import Method, evaluate_grids, evaluate_set, weights_for

UNSEEN, SEEN = "unseen", "seen"


def evaluation_report(
    gathered: Gathered,
    baselines: BaselineMethods,
    models: Sequence[EvaluatedMethod],
    runs: Sequence[EvaluatedRun],
    sets: Mapping[str, Sequence[int]],
    fit: Sequence[str],
    resamples: int,
    seed: int,
    arrival: Arrival | None = None,
) -> dict[str, Any]:
    """All tables and curves. Scenes in houses that a method was trained on are a separate part.

    `sets` has candidate sets by name, each with the indices of the runs that offer it.
    """
    columns, evaluated = gathered.columns, [*baselines.baselines, *models]
    seen_houses = baselines.houses.union(*(model.houses for model in models))
    methods = [c.method for c in evaluated]
    objects = frozenset[str]().union(*(c.objects for c in evaluated))
    is_seen = np.isin(columns.house.astype(str), np.array(sorted(seen_houses), str))
    sides = [(name, rows) for name, rows in ((UNSEEN, ~is_seen), (SEEN, is_seen)) if rows.any()]
    parts = [
        {
            "houses": name,
            **_part(
                columns.of_scenes(rows), methods, sets, objects, resamples, seed, len(sides) > 1, arrival
            ),
        }
        for name, rows in sides
    ]
    n = len(columns)
    return {
        "datagen": __version__,
        "paper": paper_record(),
        "runs": [run.record() for run in runs],
        "fitted_on": list(fit),
        "methods": [
            {
                **c.record(),
                "seconds": gathered.seconds[c.name],
                "seconds_per_600": gathered.seconds[c.name] * paper_results.TIMED_CANDIDATES / n,
            }
            for c in evaluated
        ],
        "left_out": baselines.left_out,
        "bootstrap": {"resamples": resamples, "seed": seed, "level": LEVEL, "by": "scene"},
        "candidates": list(sets),
        "seen_houses": sorted(set(columns.house[is_seen].tolist())),
        "parts": parts,
    }


def _part(
    columns: Columns,
    methods: Sequence[Method],
    sets: Mapping[str, Sequence[int]],
    objects: frozenset[str],
    resamples: int,
    seed: int,
    is_one_of_two: bool,
    arrival: Arrival | None,
) -> dict[str, Any]:
    """The tables of one part. A set with too few scenes in one of two parts is omitted."""
    scored: dict[str, Any] = {}
    left_out: dict[str, str] = {}
    for name, runs in sets.items():
        covered = columns.of_scenes(np.isin(columns.run, runs))
        weights = weights_for(covered, resamples, seed)
        try:
            scored[name] = {
                **evaluate_set(covered, methods, name, weights, objects, seed),
                "runs": list(runs),
            }
        except InputError as error:
            if not is_one_of_two:
                raise
            left_out[name] = error.problem
    grids, why = None, None
    if not columns.is_grid.any():
        why = "no scene has a whole grid of one robot: submit sim with --candidates-per-scene grid"
    else:
        whole = columns.of_scenes(columns.is_grid)
        weights = weights_for(whole, resamples, seed)
        grids = evaluate_grids(whole, methods, weights, seed)
        grids["arrivals"] = arrival_table(whole, methods, weights, arrival)
        if grids["scenes"] == grids["scenes_without_positive"]:
            grids, why = None, f"none of {grids['scenes']} whole grids has a positive candidate"
    return {
        "scenes": columns.n_scenes,
        "house_count": len(set(columns.house.tolist())),
        "candidates": len(columns),
        "sets": scored,
        "left_out": left_out,
        "grids": grids,
        "no_grids": why,
    }


def paper_record() -> dict[str, Any]:
    """The paper's numbers for the report."""
    return {
        "source": paper_results.SOURCE,
        "accuracy": dict(paper_results.ACCURACY),
        "accuracy_out_of_reach": paper_results.ACCURACY_OUT_OF_REACH,
        "grid_selection": paper_results.GRID_SELECTION,
        "grid_miss_m": paper_results.GRID_MISS_M,
        "seconds_per_600": paper_results.TIMED_S,
    }
