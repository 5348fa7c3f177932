"""The quantities by which shards and scenes are compared to find outliers."""

from __future__ import annotations

import numpy as np

from datagen.html_report.outliers import F64, Measure, arcsine, log
from datagen.html_report.part_columns import PartColumns
from datagen.html_report.report_paths import ReportedPart

POSITIVE, TIME, REJECTED, SETTLING, VISIBLE = (
    "positive rate",
    "wall time per label",
    "rejected tries per scene",
    "settling steps",
    "visible share of the target",
)


def shard_measures(part: ReportedPart, columns: PartColumns | None) -> list[Measure]:
    """Measures of the part's shards, in the order of `part.shards`.

    The first three are from commits and cover all shards; the others are means over the scenes of the shards
    that were read. A sealed store has no commits: its positive rate is of the shards that were read.
    """
    rows = {shard: row for row, shard in enumerate(part.shards)}
    unknown = np.full(len(rows), np.nan)
    positive, time_ms, rejected, steps, visible = (unknown.copy() for _ in range(5))
    for shard, commit in part.commits.items():
        if (row := rows.get(shard)) is not None and commit.samples and commit.scenes:
            positive[row] = commit.positives / commit.samples
            time_ms[row] = 1000 * commit.cost.all_s["wall"] / commit.samples
            rejected[row] = sum(commit.redraws.values()) / commit.scenes
    if columns is not None:
        for shard in columns.chosen:
            scenes = columns.shard == shard
            steps[rows[shard]] = columns.scenes["settle_steps"][scenes].mean()
            visible[rows[shard]] = columns.scenes["target_visible_fraction"][scenes].mean()
            if part.run is None:
                positive[rows[shard]] = columns.samples["label"][scenes[columns.scene]].mean()
    return [
        Measure(POSITIVE, positive, arcsine, "%"),
        Measure(TIME, time_ms, log, "ms"),
        Measure(REJECTED, rejected, np.sqrt),
        Measure(SETTLING, steps, log),
        Measure(VISIBLE, visible, arcsine, "%"),
    ]


def scene_measures(columns: PartColumns) -> list[Measure]:
    """Measures of the scenes of `columns`, in their order."""
    samples, scenes = columns.samples, columns.scenes
    ones = np.ones(len(columns))
    near, label = columns.is_in_range, samples["label"].astype(np.float64)
    measures = [
        Measure(
            "positive rate within reach", _ratio(columns, label * near, near.astype(float)), arcsine, "%"
        ),
        Measure("share of free base poses", _ratio(columns, samples["base_is_clear"], ones), arcsine, "%"),
        Measure(SETTLING, scenes["settle_steps"].astype(np.float64), log),
        Measure(VISIBLE, scenes["target_visible_fraction"].astype(np.float64), arcsine, "%"),
        Measure("rejected tries", scenes["redraws"].sum(axis=1).astype(np.float64), np.sqrt),
        Measure("height of the target", scenes["target_center_m"][:, 2].astype(np.float64), np.asarray, "m"),
    ]
    if "heuristic_label" in samples:
        same = (samples["heuristic_label"] == samples["label"]) & near
        agreed = _ratio(columns, same.astype(np.float64), near.astype(np.float64))
        measures.append(Measure("agreement with the heuristic within reach", agreed, arcsine, "%"))
    return measures


def _ratio(columns: PartColumns, part: F64, whole: F64) -> F64:
    """Sums (S,) of `part` (N,) over those of `whole` (N,); nan where the latter are 0."""
    count = columns.per_scene(whole)
    return np.where(count > 0, columns.per_scene(part) / np.maximum(count, 1), np.nan)
