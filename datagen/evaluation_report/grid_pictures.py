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
from matplotlib.patheffects import withStroke

from datagen.evaluation_report.svg import new_figure
from datagen.schemas.styles import BEST, CELL_COLOURS, SCORE_COLOURS, TARGET
from datagen.train.evaluation.columns import Columns, Example
from datagen.train.evaluation.grids import picks

_MOST_METHODS = 5
_PANEL_IN = 2.55
_TRUTH = ListedColormap(CELL_COLOURS)
_REACH_COLOUR = "#1b3a6b"
GRIDS_CAPTION = (
    "Scenes drawn at random from those with a good base pose, seen from above; x and y are relative to the "
    "target. Truth: blue is good, pale orange is bad, grey is where the base collides. Methods: their scores "
    "where the base fits, from red (lowest) to blue (highest). The pick is a gold star where it is good, a "
    "white cross where it is bad. The dashed circle is the arm's reach; the target's points are pink."
)
F64 = npt.NDArray[np.float64]


def draw_examples(
    examples: Sequence[Example], columns: Columns, records: Sequence[Mapping[str, Any]]
) -> Figure:
    """One row per scene: the cloud from above, the truth, and each method's scores with its pick.

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
        seen.set_ylabel(f"{columns.target[example.scene]}\ny [m]", fontsize=9)
        _draw_truth(truth, grid)
        for ax, name in zip(scored, names, strict=True):
            _draw_scores(ax, grid, grid.scores[name])
        if row == 0:
            for ax, title in zip(panels[0], ("cloud", "truth", *names), strict=True):
                ax.set_title(title, fontsize=10)
    for ax in panels[-1]:
        ax.set_xlabel("x [m]", fontsize=9)
    for ax in panels.ravel():
        ax.set_aspect("equal")
        ax.locator_params(nbins=3)
        ax.tick_params(labelsize=8)
        ax.label_outer()
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
    ax.scatter(target[:, 0], target[:, 1], s=4, color=TARGET.colour, lw=0, rasterized=True)
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
    _draw_image(ax, grid, shown, cmap=SCORE_COLOURS)
    _draw_reach(ax, grid)
    ax.plot(0, 0, "+", color="black", ms=8)
    share = picks(score, np.zeros(len(grid), np.int64), grid.is_clear)
    tied = np.flatnonzero(share)
    # Of several best scores the first is shown, with their number.
    pick = tied[0]
    is_good = bool(grid.label[pick])
    colour, marker = (BEST.colour, BEST.marker) if is_good else ("white", "X")
    ax.scatter(
        *grid.base_xy_m[pick], marker=str(marker), s=150 if is_good else 90, color=colour, edgecolors="black",
        lw=1.1, zorder=5,
    )  # fmt: skip
    words = "pick is good" if is_good else "pick is bad"
    if len(tied) > 1:
        words = f"{len(tied)} tied, {100 * float(share[grid.label].sum()):.0f}% good"
    halo = [withStroke(linewidth=2.5, foreground="white")]
    ax.text(0.03, 0.03, words, transform=ax.transAxes, fontsize=9, zorder=6, path_effects=halo)


def _draw_reach(ax: Axes, grid: Columns) -> None:
    """Horizontal distance (m) within the arm's reach of the target."""
    reach_m, mount_m, planar_m = (float(a[0]) for a in (grid.reach_m, grid.mount_distance_m, grid.distance_m))
    left_m2 = reach_m**2 - max(mount_m**2 - planar_m**2, 0.0)
    if left_m2 > 0:
        circle = Circle((0, 0), left_m2**0.5, fill=False, ls="--", lw=1, edgecolor=_REACH_COLOUR)
        ax.add_patch(circle)
