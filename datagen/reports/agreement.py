"""Labels of runs as arrays, their agreement for the same candidates, and statistics of outcomes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.outcomes import OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import Array, read_committed
from datagen.workers.bases.candidate_sets import (
    DISTANCE_EDGES_M,
    TENTHS,
    VISIBILITY_EDGES,
    Bools,
    Edges,
    Floats,
    bands,
    in_set,
)

Rows = npt.NDArray[np.intp]

REACH_EDGES_M: Edges = (0.0, *TENTHS[3:], None)
HEIGHT_EDGES_M: Edges = (0.0, *TENTHS[5:], None)


_COLUMNS = {
    "sample_scene_index": "scene",
    "candidate_index": "candidate",
    "label": "label",
    "base_is_clear": "is_clear",
    "distance_m": "distance_m",
    "mount_distance_m": "mount_distance_m",
    "visibility": "visibility",
    "arm_reach_m": "reach_m",
    "base_height_m": "height_m",
}


@dataclass(frozen=True, eq=False)
class Labelled:
    """N candidates with a label and the quantities to group them by. Arrays are (N,)."""

    scene: npt.NDArray[np.int64]
    candidate: npt.NDArray[np.int32]
    label: Bools
    is_clear: Bools
    distance_m: Floats
    mount_distance_m: Floats
    visibility: Floats
    reach_m: Floats
    height_m: Floats
    target: npt.NDArray[Any]  # the object's name
    outcome: npt.NDArray[np.uint8] | None  # code of OUTCOMES; None where the label has no cause

    def __len__(self) -> int:
        return len(self.label)

    def at(self, rows: Rows | Bools) -> Labelled:
        """Some of the candidates."""
        cut = {name: getattr(self, name)[rows] for name in ROWS}
        return Labelled(**cut, outcome=None if self.outcome is None else self.outcome[rows])

    def is_in(self, candidates: str) -> Bools:
        """Mask (N,) of the candidates in a set of CANDIDATE_SETS."""
        return in_set(candidates, self.is_clear, self.mount_distance_m, self.reach_m)


# The arrays that every label source has.
ROWS = tuple(f.name for f in fields(Labelled) if f.name != "outcome")


def common_candidates(a: Labelled, b: Labelled) -> tuple[Labelled, Labelled]:
    """The candidates that both labelled, by scene and index, in the same order."""
    # A scene has fewer than 2^32 candidates.
    keys = [side.scene * 2**32 + side.candidate for side in (a, b)]
    _, rows_a, rows_b = np.intersect1d(*keys, assume_unique=True, return_indices=True)
    return a.at(rows_a), b.at(rows_b)


def confusion(said: Bools, true: Bools) -> dict[str, int]:
    """Confusion counts of predicted labels `said` (N,) and reference labels `true` (N,)."""
    return {
        "true_positive": int((said & true).sum()),
        "false_positive": int((said & ~true).sum()),
        "false_negative": int((~said & true).sum()),
        "true_negative": int((~said & ~true).sum()),
    }


def agreement(said: Bools, true: Bools) -> dict[str, Any]:
    """Counts, shares and accuracies; None where they are undefined.

    Balanced accuracy is the mean of sensitivity and specificity: 0.5 for a constant rule, however rare
    positives are.
    """
    n, positives = len(true), int(true.sum())
    found = float(said[true].mean()) if positives else None
    refused = float((~said)[~true].mean()) if positives < n else None
    return {
        "count": n,
        "said_positive": int(said.sum()),
        "true_positive_share": positives / n if n else None,
        "accuracy": float((said == true).mean()) if n else None,
        "balanced_accuracy": (found + refused) / 2 if found is not None and refused is not None else None,
    }


def compare(said: Labelled, true: Labelled) -> dict[str, Any]:
    """Compare the labels of `said` with those of `true`, for the same candidates in the same order."""

    def by_band(values: Floats, edges: Edges) -> list[dict[str, Any]]:
        return [
            {"low": low, "high": high, **agreement(said.label[rows], true.label[rows])}
            for low, high, rows in bands(values, edges)
        ]

    names = sorted({str(name) for name in true.target})
    objects = [(name, true.target == name) for name in names]
    return {
        **agreement(said.label, true.label),
        "confusion": confusion(said.label, true.label),
        "by_distance": by_band(true.distance_m, DISTANCE_EDGES_M),
        "by_visibility": by_band(true.visibility, VISIBILITY_EDGES),
        "by_reach": by_band(true.reach_m, REACH_EDGES_M),
        "by_object": [
            {"object": name, **agreement(said.label[rows], true.label[rows])} for name, rows in objects
        ],
        "by_outcome": _by_outcome(said, true),
    }


def _by_outcome(said: Labelled, true: Labelled) -> list[dict[str, Any]]:
    """For each outcome of `true`, its count and the number of predicted positives."""
    if true.outcome is None:
        return []
    return [
        {"outcome": name, "count": int(rows.sum()), "said_positive": int(said.label[rows].sum())}
        for code, name in enumerate(OUTCOMES)
        if (rows := true.outcome == code).any()
    ]


def outcome_report(labelled: Labelled) -> dict[str, Any]:
    """Return outcomes and deciding stages with count and share, and the share of positives by band."""
    assert labelled.outcome is not None
    n = len(labelled)
    counts = np.bincount(labelled.outcome, minlength=len(OUTCOMES))
    outcomes: list[dict[str, Any]] = [
        {"outcome": name, "stage": OUTCOMES[name], "count": int(count), "share": int(count) / n}
        for name, count in zip(OUTCOMES, counts, strict=True)
        if count
    ]
    # Failures by the stage that decided them.
    stages = dict.fromkeys(OUTCOMES.values(), 0)
    for row in outcomes:
        if row["outcome"] != "success":
            stages[row["stage"]] += row["count"]

    def share_by(values: Floats, edges: Edges) -> list[dict[str, Any]]:
        return [
            {"low": low, "high": high, "count": int(rows.sum()), "positive": int(labelled.label[rows].sum())}
            for low, high, rows in bands(values, edges)
        ]

    return {
        "count": n,
        "outcomes": outcomes,
        "failures_by_stage": [
            {"stage": s, "count": count, "share": count / n} for s, count in stages.items() if count
        ],
        "positive_by": {
            "distance": share_by(labelled.distance_m, DISTANCE_EDGES_M),
            "reach": share_by(labelled.reach_m, REACH_EDGES_M),
            "height": share_by(labelled.height_m, HEIGHT_EDGES_M),
        },
    }


def read_labelled(run: Run) -> Labelled | None:
    """All committed candidates of a run, also beyond n; None without any. InputError for a damaged file."""
    has_outcome = any(f.name == "outcome" for f in run.schema.sample_fields)
    names = [*_COLUMNS, "object_name", *(["outcome"] if has_outcome else [])]
    shards = [read_committed(run.storage, run.commit_of(shard), names) for shard in sorted(run.committed())]
    if not shards:
        return None
    per_scene = run.layout.candidates_per_scene

    def joined(parts: Iterable[Array]) -> Any:
        return np.concatenate(list(parts))

    columns = {to: joined(shard[name] for shard in shards) for name, to in _COLUMNS.items()}
    columns["label"] = columns["label"].astype(np.bool_)
    return Labelled(
        **columns,
        target=joined(np.repeat(shard["object_name"][:, 0], per_scene) for shard in shards),
        outcome=joined(shard["outcome"] for shard in shards) if has_outcome else None,
    )


def join_labelled(parts: list[Labelled]) -> Labelled:
    """Join candidates of several runs of one schema."""
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ROWS}
    outcomes = [part.outcome for part in parts if part.outcome is not None]
    return Labelled(**rows, outcome=np.concatenate(outcomes) if outcomes else None)
