"""Whole grids of a few scenes: labels, and the scores and the choice of each method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from datagen.evaluating.svg import new_figure
from datagen.train.evaluation.columns import Columns, Example
from datagen.train.evaluation.grids import picks

_MOST_METHODS = 5
_PANEL_IN = 2.55
# Cells: base not clear, clear and negative, positive.
_TRUTH = ListedColormap(["#b9b9b9", "#f1d9c9", "#0a9148"])
_REACH_COLOUR = "#1b3a6b"
F64 = npt.NDArray[np.float64]


def draw_examples(
    examples: Sequence[Example], columns: Columns, records: Sequence[Mapping[str, Any]]
) -> Figure:
    """Draw one row per scene: the plan, the labels, and each method's scores with its choice as a star.

    Up to five methods are shown: the models, then the first baselines.
    """
    order = sorted(records, key=lambda record: record["regime"] is None)[:_MOST_METHODS]
    names = [record["name"] for record in order]
    figure = new_figure(_PANEL_IN * (2 + len(names)), 0.55 + _PANEL_IN * len(examples) * 1.08)
    panels = figure.subplots(len(examples), 2 + len(names), squeeze=False)
    for row, example in enumerate(examples):
        rows = columns.scene == example.scene
        grid = columns.at(rows)
        seen, truth, *scored = panels[row].tolist()
        _draw_cloud(seen, example, grid)
        seen.set_ylabel(str(columns.target[example.scene]), fontsize=8)
        _draw_truth(truth, grid)
        for ax, name in zip(scored, names, strict=True):
            _draw_scores(ax, grid, grid.scores[name])
        if row == 0:
            for ax, title in zip(panels[0], ("view from above", "labels", *names), strict=True):
                ax.set_title(title, fontsize=10)
    for ax in panels.ravel():
        ax.set_aspect("equal")
        ax.set_xticks([])
        ax.set_yticks([])
    return figure


def _cells(grid: Columns, values: F64) -> tuple[F64, tuple[float, float, float, float]]:
    """Values (N,) as an image (rows by y) and its extent; the N candidates fill a square grid."""
    side = round(len(grid) ** 0.5)
    order = np.lexsort([grid.base_xy_m[:, 0], grid.base_xy_m[:, 1]])
    # Cells of a row have equal y except for float32 rounding.
    image = np.empty((side, side))
    by_row = order.reshape(side, side)
    for k, row in enumerate(by_row):
        image[k] = values[row[np.argsort(grid.base_xy_m[row, 0], kind="stable")]]
    low, high = grid.base_xy_m.min(axis=0), grid.base_xy_m.max(axis=0)
    half = (high - low) / (2 * max(side - 1, 1))
    (left, bottom), (right, top) = (low - half).tolist(), (high + half).tolist()
    return image, (left, right, bottom, top)


def _draw_image(ax: Axes, grid: Columns, values: F64, **look: Any) -> None:
    image, edges = _cells(grid, values)
    ax.imshow(image, origin="lower", extent=edges, interpolation="nearest", **look)
    ax.set_xlim(edges[0], edges[1])
    ax.set_ylim(edges[2], edges[3])


def _draw_cloud(ax: Axes, example: Example, grid: Columns) -> None:
    low_first = np.argsort(example.points_m[:, 2])
    xyz, rgb = example.points_m[low_first], example.rgb[low_first] / 255
    ax.scatter(xyz[:, 0], xyz[:, 1], s=3, c=rgb, lw=0, rasterized=True)
    target = example.points_m[example.target_mask]
    ax.scatter(target[:, 0], target[:, 1], s=4, color="#d62728", lw=0, rasterized=True)
    _, edges = _cells(grid, np.zeros(len(grid)))
    ax.set_xlim(edges[0], edges[1])
    ax.set_ylim(edges[2], edges[3])
    _draw_reach(ax, grid)


def _draw_truth(ax: Axes, grid: Columns) -> None:
    kind = np.where(grid.label, 2.0, np.where(grid.is_clear, 1.0, 0.0))
    _draw_image(ax, grid, kind, cmap=_TRUTH, norm=BoundaryNorm([-0.5, 0.5, 1.5, 2.5], 3))
    _draw_reach(ax, grid)
    ax.plot(0, 0, "+", color="black", ms=8)


def _draw_scores(ax: Axes, grid: Columns, score: F64) -> None:
    shown = np.where(grid.is_clear & np.isfinite(score), score, np.nan)
    ax.set_facecolor(_TRUTH(0))
    _draw_image(ax, grid, shown, cmap="RdYlGn")
    _draw_reach(ax, grid)
    ax.plot(0, 0, "+", color="black", ms=8)
    share = picks(score, np.zeros(len(grid), np.int64), grid.is_clear)
    tied = np.flatnonzero(share)
    # Where several cells have the best score, the first is shown with their number.
    pick = tied[0]
    is_good = bool(grid.label[pick])
    look = {"s": 150, "color": "gold", "edgecolors": "black" if is_good else "#d00000", "lw": 1.1}
    ax.scatter(*grid.base_xy_m[pick], marker="*", zorder=5, **look)
    good = float(share[grid.label].sum())
    if len(tied) > 1:
        words = f"{len(tied)} tied, {100 * good:.0f}% good"
    else:
        words = "good" if is_good else "bad"
    ax.set_xlabel(words, fontsize=8, color="#0a7a3c" if good >= 0.5 else "#c00000")


def _draw_reach(ax: Axes, grid: Columns) -> None:
    """Horizontal distance (m) within the arm's reach of the target."""
    reach_m, mount_m, planar_m = (float(a[0]) for a in (grid.reach_m, grid.mount_distance_m, grid.distance_m))
    left_m2 = reach_m**2 - max(mount_m**2 - planar_m**2, 0.0)
    if left_m2 > 0:
        circle = Circle((0, 0), left_m2**0.5, fill=False, ls="--", lw=1, edgecolor=_REACH_COLOUR)
        ax.add_patch(circle)
