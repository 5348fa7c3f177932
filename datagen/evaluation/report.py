"""The evaluation as plain values: methods, runs, and every number with its interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen import __version__
from datagen.evaluation.columns import Columns
from datagen.evaluation.comparisons import SEED, Method
from datagen.evaluation.grids import arrival_table, decisive_grids
from datagen.evaluation.methods import EvaluatedMethod
from datagen.evaluation.runs import EvaluatedRun
from datagen.evaluation.score_files import ScoreFile
from datagen.evaluation.scores import evaluate_grids, evaluate_set, weights_for
from datagen.schemas.errors import InputError
from datagen.schemas.specification import PLACE_KINDS
from datagen.train.arrivals import Arrival
from datagen.train.bootstrap import LEVEL

RESAMPLES = 1000
# GBPP: Grasp-Aware Base Placement Prediction for Robots via Two-Stage Learning, Tables I to III and text. Not
# directly comparable: it has other candidates, houses and arms. `accuracy` is by baseline, and by regime of
# its network; numbers of grids are those of the two-stage model, its time that of a laptop's RTX 4090.
PAPER = {
    "source": "GBPP, arXiv:2509.11594",
    "accuracy": {
        "proximity": 0.4691,
        "threshold": 0.5691,
        "stage1": 0.7675,
        "sim-only": 0.7911,
        "two-stage": 0.8413,
    },
    "accuracy_out_of_reach": 0.9917,
    "grid_selection": 0.9466,
    "grid_miss_m": 0.24,
    "seconds_per_600": 0.3,
}


@dataclass(frozen=True, eq=False)
class Part:
    """Scenes with tables of their own, and the candidate sets to report, each with the runs that cover it."""

    title: str
    columns: Columns
    sets: Mapping[str, Sequence[int]]


def parts_by_houses(
    columns: Columns, seen_houses: frozenset[str], sets: Mapping[str, Sequence[int]]
) -> list[Part]:
    """The scenes in houses that no method was trained on, and the others, where there are some."""
    is_seen = np.isin(columns.house.astype(str), np.array(sorted(seen_houses), str))
    sides = (("unseen houses", ~is_seen), ("training houses", is_seen))
    return [Part(title, columns.of_scenes(rows), sets) for title, rows in sides if rows.any()]


def parts_of_grids(name: str, columns: Columns) -> list[Part]:
    """Whole grids, and those of them that are decisive, where there are some."""
    sides = ((name, columns.is_grid), (f"{name}, decisive", decisive_grids(columns)))
    return [Part(title, columns.of_scenes(rows), {}) for title, rows in sides if rows.any()]


def parts_by_place(columns: Columns) -> list[Part]:
    """The whole grids of all runs by the kind of place, where there is more than one kind."""
    some = np.unique(columns.place[columns.is_grid]).tolist()
    rows = {PLACE_KINDS[k]: columns.is_grid & (columns.place == k) for k in some}
    return [Part(f"grids, {kind}", columns.of_scenes(r), {}) for kind, r in rows.items() if len(rows) > 1]


def evaluation_report(
    seconds_per_600: Mapping[str, float],
    methods: Sequence[EvaluatedMethod],
    runs: Sequence[EvaluatedRun],
    parts: Sequence[Part],
    fit: Sequence[str],
    left_out: Mapping[str, str],
    arrivals: Sequence[Arrival] = (),
) -> dict[str, Any]:
    """All numbers; undefined ones are None. `seconds_per_600` candidates are by method.

    InputError where no part has a table.
    """
    judged = [each.method for each in methods]
    made = [_part(part, judged, arrivals) for part in parts]
    if not any(part["sets"] or part["grids"] for part in made):
        (name, problem), *_ = made[0]["left_out"].items()
        raise InputError(f"{name} candidates", "", problem, "Evaluate more scenes, with labels of both kinds")
    return {
        "datagen": __version__,
        "paper": PAPER,
        "runs": [run.record() for run in runs],
        "fitted_on": list(fit),
        "methods": [
            # Another program made the scores of a file, in a time that is not known.
            each.record()
            | {"seconds_per_600": None if isinstance(each.scorer, ScoreFile) else seconds_per_600[each.name]}
            for each in methods
        ],
        "left_out": dict(left_out),
        "bootstrap": {"resamples": RESAMPLES, "seed": SEED, "level": LEVEL, "by": "scene"},
        "parts": made,
    }


def _part(part: Part, methods: Sequence[Method], arrivals: Sequence[Arrival]) -> dict[str, Any]:
    """The tables of one part, and the reason of each that is left out."""
    columns = part.columns
    scored: dict[str, Any] = {}
    left_out: dict[str, str] = {}
    for name, runs in part.sets.items():
        covered = columns.of_scenes(np.isin(columns.run, runs))
        weights = weights_for(covered, RESAMPLES, SEED)
        try:
            scored[name] = evaluate_set(covered, methods, name, weights) | {"runs": list(runs)}
        except InputError as error:
            left_out[name] = error.problem
    grids = None
    if columns.is_grid.any():
        whole = columns.of_scenes(columns.is_grid)
        weights = weights_for(whole, RESAMPLES, SEED)
        grids = evaluate_grids(whole, methods, weights)
        if grids["scenes"] == grids["scenes_without_positive"]:
            left_out["whole grids"] = f"none of {grids['scenes']} has a positive candidate"
            grids = None
        else:
            grids["arrivals"] = arrival_table(whole, methods, weights, arrivals)
    elif "grid" in part.sets:
        left_out["whole grids"] = "no scene has one of one robot: submit with --candidates-per-scene grid"
    return {
        "title": part.title,
        "scenes": columns.n_scenes,
        "houses": len(set(columns.house.tolist())),
        "candidates": len(columns),
        "sets": scored,
        "left_out": left_out,
        "grids": grids,
    }
