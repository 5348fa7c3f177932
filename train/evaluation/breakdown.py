"""Accuracy by kinds of candidates: object, distance, what is seen, cause, what was trained on."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from schemas.outcomes import OUTCOMES
from train.evaluation.columns import Columns
from train.evaluation.metrics import F64, Bools, accuracy, balanced_accuracy, confusion

_TENTHS = tuple(round(0.1 * k, 1) for k in range(11))
DISTANCE_EDGES_M = (*_TENTHS, None)
RATIO_EDGES = (0.0, 0.4, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, None)
# Those of the visibility score: hidden, partly seen, nearly free.
VISIBILITY_EDGES = (0.0, 0.04, 0.2, 0.4, 0.6, 0.8, None)

# Heading of a breakdown -> the groups of its candidates, each with its name.
Groups = Mapping[str, list[tuple[str, Bools]]]


def groups_of(columns: Columns, trained_objects: Collection[str]) -> Groups:
    """The groups (N,) that hold any candidate, by heading, in the order in which they are told."""
    ratio = columns.mount_distance_m.astype(np.float64) / columns.reach_m
    seen = np.isin(columns.target_digest.astype(str), np.array(sorted(trained_objects), str))
    target = columns.target.astype(str)
    return {
        "object": [(name, (target == name)[columns.scene]) for name in np.unique(target[columns.scene])],
        "distance (m)": list(_bands(columns.distance_m, DISTANCE_EDGES_M)),
        "mount distance / reach": list(_bands(ratio, RATIO_EDGES)),
        "visibility": list(_bands(columns.visibility, VISIBILITY_EDGES)),
        "outcome": [
            (name, rows) for code, name in enumerate(OUTCOMES) if (rows := columns.outcome == code).any()
        ],
        **({"object trained on": _yes_no(seen[columns.scene])} if trained_objects else {}),
    }


def breakdown(groups: Groups, true: Bools, said: Mapping[str, F64]) -> list[dict[str, Any]]:
    """One row a group: candidates, positives, and each method's accuracy and balanced accuracy."""
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


def _bands(
    values: npt.NDArray[np.floating[Any]], edges: Sequence[float | None]
) -> Iterator[tuple[str, Bools]]:
    for low, high in pairwise(edges):
        assert low is not None
        # Stored numbers are float32: a distance of 0.7 m belongs to the band that begins at 0.7.
        inside = values >= np.float32(low)
        if high is not None:
            inside &= values < np.float32(high)
        if inside.any():
            yield (f"{low:g} on" if high is None else f"{low:g} to {high:g}"), inside


def _yes_no(rows: Bools) -> list[tuple[str, Bools]]:
    return [(name, part) for name, part in (("yes", rows), ("no", ~rows)) if part.any()]
