"""Figures of a run: label balance over distance and angle, and the measures of its shards."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from datagen.display.figures import new_figure
from datagen.display.styles import LABEL_STYLES, SCORE_COLOURS
from datagen.html_report.outliers import THRESHOLD, Measure
from datagen.html_report.part_columns import F64, Array, PartColumns

Bools = npt.NDArray[np.bool_]

BALANCE_CAPTION = (
    "Share of positive labels by distance from the target and by the direction that the base stands in: 0 "
    "degrees is the side of the observation camera, counter-clockwise is positive. Bands are 95% intervals "
    "by scene, bars the share of candidates. The map joins the two, without cells of under 20 candidates."
)
SHARDS_CAPTION = (
    "One dot a shard, in the order of the run. The line is the median. Orange triangles, with their numbers, "
    f"have a robust z-score beyond {THRESHOLD:g}; the band holds the others."
)
_GOOD, _ODD = LABEL_STYLES[1].colour, LABEL_STYLES[0].colour
_FEWEST, _SECTOR_DEG = 20, 30
_ALPHA, _Z95 = 0.05, 1.96
_MOST_NAMED = 6
_MOST_DOTS = 2000


def draw_balance(columns: PartColumns) -> Figure:
    """Draw the positive rate by distance, by angle, and by both."""
    samples, near = columns.samples, columns.is_in_range
    distance_m, angle_deg = samples["distance_m"].astype(np.float64), angles_deg(columns)
    far_m = max(0.2, np.ceil(10 * float(distance_m.max())) / 10)
    rings_m = np.round(np.arange(0, far_m + 0.05, 0.1), 1)
    sectors_deg = np.arange(-180, 181, _SECTOR_DEG)
    figure = new_figure(12, 4.3)
    left, middle = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2)
    sets = [("all candidates", np.ones(len(columns), np.bool_))]
    if not near.all() and near.any():
        sets.append(("base fits, within reach", near))
    for ax, values, edges, words in (
        (left, distance_m, rings_m, "distance to the target (m)"),
        (middle, angle_deg, sectors_deg, "angle from the camera's side (degrees)"),
    ):
        _draw_rates(ax, columns, values, edges, sets)
        ax.set(xlabel=words, ylim=(0, 1), xlim=(edges[0], edges[-1]))
    middle.set_xticks(range(-180, 181, 60))
    left.set_ylabel("positive")
    figure.legend(
        *left.get_legend_handles_labels(), fontsize=9, loc="outside lower left", frameon=False, ncols=3
    )
    _draw_map(figure, columns, sets[-1], rings_m, sectors_deg, distance_m, angle_deg)
    return figure


def angles_deg(columns: PartColumns) -> F64:
    """Angles (N,) at the target from the observation camera to each base, in degrees, [-180, 180)."""
    scenes = columns.scenes
    target, camera = scenes["target_center_m"][:, :2], scenes["T_world_camera"][:, :2, 3]
    seen_from = np.arctan2(*(camera - target).T[::-1])
    offset = columns.samples["base_xy_m"].astype(np.float64) - target[columns.scene]
    angle = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]) - seen_from[columns.scene])
    return (angle + 180) % 360 - 180


def rate_by_scene(columns: PartColumns, rows: Bools) -> tuple[float, float, float]:
    """Positive rate of some candidates with its 95% interval, scenes as units; nan where undefined.

    The variance is that of a ratio of two sums over S scenes, sum (y - p n)^2 / (sum n)^2 times S / (S - 1)
    (Cochran, Sampling Techniques, 1977, section 6.4). A rate of 0 or 1 has the exact interval of as many
    trials as scenes (Clopper and Pearson 1934).
    """
    count = columns.per_scene(rows)
    good = columns.per_scene(rows & (columns.samples["label"] == 1))[count > 0]
    count = count[count > 0]
    n, scenes = count.sum(), len(count)
    if not n:
        return float("nan"), float("nan"), float("nan")
    rate = float(good.sum() / n)
    if rate in (0.0, 1.0):
        open_end = 1 - (_ALPHA / 2) ** (1 / scenes)
        return (rate, 0.0, open_end) if rate == 0 else (rate, 1 - open_end, 1.0)
    if scenes < 2:
        return rate, 0.0, 1.0
    half = _Z95 * float(np.sqrt(((good - rate * count) ** 2).sum() / n**2 * scenes / (scenes - 1)))
    return rate, max(0.0, rate - half), min(1.0, rate + half)


def _draw_rates(
    ax: Axes, columns: PartColumns, values: F64, edges: Array, sets: Sequence[tuple[str, Bools]]
) -> None:
    middles, widths = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    share = np.histogram(values, edges)[0] / max(len(values), 1)
    ax.bar(middles, share, widths * 0.92, color="#dfe4ea", label="share of candidates")
    for (name, rows), colour, line in zip(sets, (_GOOD, _ODD), ("-", "--"), strict=False):
        found = [
            rate_by_scene(columns, rows & (values >= low) & (values < high))
            for low, high in pairwise(edges.tolist())
        ]
        rate, low, high = np.array(found).T
        ax.plot(middles, rate, line, color=colour, marker="o", ms=4, label=f"positive, {name}")
        ax.fill_between(middles, low, high, color=colour, alpha=0.18, lw=0)
    ax.grid(axis="y", color="#e4e4e4", lw=0.7)
    ax.set_axisbelow(True)


def _draw_map(
    figure: Figure, columns: PartColumns, shown: tuple[str, Bools],
    rings_m: Array, sectors_deg: Array, distance_m: F64, angle_deg: F64,
) -> None:  # fmt: skip
    ax: Any = figure.add_subplot(1, 3, 3, projection="polar")
    name, rows = shown
    where = (angle_deg[rows], distance_m[rows])
    count = np.histogram2d(*where, (sectors_deg, rings_m))[0]
    good = np.histogram2d(*where, (sectors_deg, rings_m), weights=columns.samples["label"][rows])[0]
    scale = Normalize(0, 1)
    colours = ScalarMappable(scale, SCORE_COLOURS)
    for sector, ring in np.argwhere(count >= _FEWEST).tolist():
        middle, width = np.radians(sectors_deg[sector] + _SECTOR_DEG / 2), np.radians(_SECTOR_DEG)
        colour = colours.to_rgba(good[sector, ring] / count[sector, ring])
        ax.bar(middle, rings_m[ring + 1] - rings_m[ring], width, rings_m[ring], color=colour, lw=0)
    ax.set_ylim(0, rings_m[-1])
    ax.set_title(name, fontsize=10)
    ax.tick_params(labelsize=8)
    ax.set_thetagrids(
        range(0, 360, 45), [f"{a}°" if a else "camera" for a in (0, 45, 90, 135, 180, -135, -90, -45)]
    )
    ax.set_rlabel_position(22.5)
    ax.set_rticks(rings_m[2 :: 4 if len(rings_m) > 8 else 2])
    ax.grid(color="#bbbbbb", lw=0.4)
    figure.colorbar(colours, ax=ax, shrink=0.75, pad=0.12, label="positive")


def draw_shards(shards: Sequence[int], measures: Sequence[Measure]) -> Figure:
    """Draw every measure over the shards, and mark the outliers."""
    figure = new_figure(12, 4.6)
    panels = np.asarray(figure.subplots(2, 3)).ravel().tolist()
    number = np.array(shards, np.float64)
    for ax, measure in zip(panels, measures, strict=False):
        _draw_measure(ax, number, measure)
    for ax in panels[len(measures) :]:
        ax.remove()
    return figure


def _draw_measure(ax: Axes, number: F64, measure: Measure) -> None:
    unit = f" ({measure.unit})" if measure.unit else ""
    ax.set_title(measure.name + unit, fontsize=10)
    ax.set_xlabel("shard", fontsize=9)
    ax.margins(y=0.15)
    ax.tick_params(labelsize=8)
    known = np.isfinite(measure.values)
    factor = 100 if measure.unit == "%" else 1
    values, scores = factor * measure.values, measure.scores
    odd = np.abs(scores) > THRESHOLD
    usual = known & ~odd
    # Many dots are one image, so that the page stays small.
    as_image = bool(known.sum() > _MOST_DOTS)
    ax.plot(number[usual], values[usual], "o", ms=3, mew=0, color=_GOOD, alpha=0.6, rasterized=as_image)
    ax.plot(number[odd], values[odd], "v", ms=6, mec="white", mew=0.5, color=_ODD)
    ax.axhline(factor * measure.median, color="#555555", lw=1)
    if usual.any() and np.ptp(scores[known]) > 0:
        low, high = values[usual].min(), values[usual].max()
        ax.axhspan(low, high, color="#dfe4ea", lw=0, zorder=0)
    for row in np.flatnonzero(odd)[np.argsort(-np.abs(scores[odd]))][:_MOST_NAMED].tolist():
        ax.annotate(
            f"{number[row]:.0f}", (number[row], values[row]), (4, 3), textcoords="offset points", fontsize=8
        )
