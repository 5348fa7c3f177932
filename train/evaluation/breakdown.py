"""Accuracy by groups of candidates: object, distance, visibility, outcome, training."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from datagen.schemas.outcomes import OUTCOMES
from datagen.train.evaluation.columns import Columns
from datagen.train.evaluation.metrics import accuracy, balanced_accuracy, confusion
from datagen.train.inputs import F64, Bools
from datagen.workers.bases.candidate_sets import DISTANCE_EDGES_M, VISIBILITY_EDGES, Edges, Floats, bands

RATIO_EDGES: Edges = (0.0, 0.4, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, None)

# Heading of a breakdown -> its groups of candidates, by name.
Groups = Mapping[str, list[tuple[str, Bools]]]


def groups_of(columns: Columns, trained_objects: Collection[str]) -> Groups:
    """The non-empty groups (N,), by heading, in order of the report."""
    ratio = columns.mount_distance_m.astype(np.float64) / columns.reach_m
    seen = np.isin(columns.target_digest.astype(str), np.array(sorted(trained_objects), str))
    target = columns.target.astype(str)
    return {
        "object": [(name, (target == name)[columns.scene]) for name in np.unique(target[columns.scene])],
        "distance (m)": _named_bands(columns.distance_m, DISTANCE_EDGES_M),
        "mount distance / reach": _named_bands(ratio, RATIO_EDGES),
        "visibility": _named_bands(columns.visibility, VISIBILITY_EDGES),
        "outcome": [
            (name, rows) for code, name in enumerate(OUTCOMES) if (rows := columns.outcome == code).any()
        ],
        **({"object trained on": _yes_no(seen[columns.scene])} if trained_objects else {}),
    }


def breakdown(groups: Groups, true: Bools, said: Mapping[str, F64]) -> list[dict[str, Any]]:
    """One row per group: candidates, positives, and each method's accuracy and balanced accuracy."""
    return [
        {
            "by": heading,
            "group": name,
            "count": int(rows.sum()),
            "positives": int(true[rows].sum()),
            "methods": {method: _accuracies(said[method][rows], true[rows]) for method in said},
        }
        for heading, members in groups.items()
        for name, rows in members
    ]


def _accuracies(said: F64, true: Bools) -> dict[str, float]:
    counts = confusion(said, true, np.zeros(len(true), np.int64), 1)[0]
    return {"accuracy": float(accuracy(counts)), "balanced_accuracy": float(balanced_accuracy(counts))}


def _named_bands(values: Floats, edges: Edges) -> list[tuple[str, Bools]]:
    found = bands(values, edges)
    return [(f"{low:g} on" if high is None else f"{low:g} to {high:g}", rows) for low, high, rows in found]


def _yes_no(rows: Bools) -> list[tuple[str, Bools]]:
    return [(name, part) for name, part in (("yes", rows), ("no", ~rows)) if part.any()]
