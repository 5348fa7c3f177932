"""Labels of runs as arrays, their agreement for the same candidates, and statistics of outcomes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.reports.error_map import error_map
from datagen.reports.scene_intervals import codes_of, estimates_by_group
from datagen.reports.target_frame import SIDES, in_edge_frame, side_of, towards_nearest_edge
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
# Edges of the distance from the arm's mount to the target, in reaches of the arm.
OVER_REACH_EDGES: Edges = (0.0, 0.4, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, None)

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
_SCENE_COLUMNS = ("object_name", "support_type", "T_world_support", "support_size_m", "target_center_m")


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
    edge_xy_m: npt.NDArray[np.float64]  # (N, 2), base position in the frame of `target_frame.in_edge_frame`
    target: npt.NDArray[Any]  # the object's name
    furniture: npt.NDArray[Any]  # the type of the furniture that carries the target
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


def confusion(predicted: Bools, true: Bools) -> dict[str, int]:
    """Confusion counts of labels `predicted` (N,) and reference labels `true` (N,)."""
    return {
        "true_positive": int((predicted & true).sum()),
        "false_positive": int((predicted & ~true).sum()),
        "false_negative": int((~predicted & true).sum()),
        "true_negative": int((~predicted & ~true).sum()),
    }


def agreement(predicted: Bools, true: Bools) -> dict[str, Any]:
    """Counts, shares and accuracies; None where they are undefined.

    Balanced accuracy is the mean of sensitivity and specificity: 0.5 for a constant rule, however rare
    positives are.
    """
    n, positives = len(true), int(true.sum())
    sensitivity = float(predicted[true].mean()) if positives else None
    specificity = float((~predicted)[~true].mean()) if positives < n else None
    return {
        "count": n,
        "said_positive": int(predicted.sum()),
        "true_positive_share": positives / n if n else None,
        "accuracy": float((predicted == true).mean()) if n else None,
        "balanced_accuracy": (sensitivity + specificity) / 2
        if sensitivity is not None and specificity is not None
        else None,
    }


def compare(predicted: Labelled, true: Labelled) -> dict[str, Any]:
    """Compare the labels of `predicted` with those of `true`, for the same candidates in the same order.

    Intervals of 95% are by scene (`scene_intervals`). Groups are by quantities of `true`.
    """

    def by_code(group: npt.NDArray[np.integer[Any]], keys: list[dict[str, Any]]) -> list[dict[str, Any]]:
        estimates = estimates_by_group(predicted.label, true.label, true.scene, group, len(keys))
        each = (group == g for g in range(len(keys)))
        return [
            key | agreement(predicted.label[rows], true.label[rows]) | estimate
            for key, rows, estimate in zip(keys, each, estimates, strict=True)
        ]

    def by_band(values: Floats, edges: Edges) -> list[dict[str, Any]]:
        group, keys = np.zeros(len(true), np.int64), list[dict[str, Any]]()
        for low, high, rows in bands(values, edges):
            group[rows] = len(keys)
            keys.append({"low": low, "high": high})
        return by_code(group, keys)

    def by_name(key: str, values: npt.NDArray[Any]) -> list[dict[str, Any]]:
        names, codes = codes_of(values)
        return by_code(codes, [{key: name} for name in names])

    over_reach = true.mount_distance_m / true.reach_m
    sides = np.array(SIDES)[side_of(true.edge_xy_m)]
    (whole,) = by_code(np.zeros(len(true), np.int64), [{}])
    return {
        **whole,
        "confusion": confusion(predicted.label, true.label),
        "by_distance": by_band(true.distance_m, DISTANCE_EDGES_M),
        "by_distance_over_reach": by_band(over_reach, OVER_REACH_EDGES),
        "by_visibility": by_band(true.visibility, VISIBILITY_EDGES),
        "by_reach": by_band(true.reach_m, REACH_EDGES_M),
        "by_height": by_band(true.height_m, HEIGHT_EDGES_M),
        "by_object": by_name("object", true.target),
        "by_furniture": by_name("furniture", true.furniture),
        "by_side": by_name("side", sides),
        "by_outcome": _by_outcome(predicted, true),
        "error_map": error_map(predicted.label, true.label, true.edge_xy_m),
    }


def _by_outcome(predicted: Labelled, true: Labelled) -> list[dict[str, Any]]:
    """For each outcome of `true`, its count, the predicted positives, and the accuracy with its interval."""
    if true.outcome is None:
        return []
    codes, group = np.unique(true.outcome, return_inverse=True)
    estimates = estimates_by_group(predicted.label, true.label, true.scene, group, len(codes))
    names = tuple(OUTCOMES)
    return [
        {
            "outcome": names[code],
            "count": estimate["count"],
            "said_positive": int(predicted.label[group == g].sum()),
            **{key: estimate[key] for key in ("scenes", "accuracy", "accuracy_interval")},
        }
        for g, (code, estimate) in enumerate(zip(codes.tolist(), estimates, strict=True))
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
    names = [*_COLUMNS, *_SCENE_COLUMNS, "base_xy_m", *(["outcome"] if has_outcome else [])]
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
        edge_xy_m=joined(_edge_xy_m(shard, per_scene) for shard in shards),
        target=joined(np.repeat(shard["object_name"][:, 0], per_scene) for shard in shards),
        furniture=joined(np.repeat(shard["support_type"], per_scene) for shard in shards),
        outcome=joined(shard["outcome"] for shard in shards) if has_outcome else None,
    )


def _edge_xy_m(shard: dict[str, Array], per_scene: int) -> Array:
    center_m = shard["target_center_m"]
    towards = towards_nearest_edge(shard["T_world_support"], shard["support_size_m"], center_m)
    each = (np.repeat(values, per_scene, axis=0) for values in (center_m[:, :2], towards))
    return in_edge_frame(shard["base_xy_m"], *each)


def join_labelled(parts: list[Labelled]) -> Labelled:
    """Join candidates of several runs of one schema."""
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ROWS}
    outcomes = [part.outcome for part in parts if part.outcome is not None]
    return Labelled(**rows, outcome=np.concatenate(outcomes) if outcomes else None)
