"""Figures of a report: labels on the floor, scenes, and the course of a training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from datagen.display.figures import new_figure
from datagen.display.styles import CAMERA, LABEL_STYLES, MODEL_COLOURS, SCORE_COLOURS, TARGET
from datagen.html_report.run_columns import Bools, RunColumns

FLOOR_CAPTION = (
    "The floor around the target (pink), with the observation camera below: the share of good base poses in "
    "each cell, from red (none) to blue (all). Right: the same share by distance from the target. Grey bars "
    "are the number of candidates."
)
_FEWEST = 3  # cells with fewer candidates are left out
_CELL_M = 0.1


def draw_floor(columns: RunColumns) -> Figure:
    """Draw the share of good base poses by place and by distance, of all candidates and of those near."""
    near = columns.is_near
    sets: list[tuple[str, Bools]] = [("all candidates", np.ones(len(near), np.bool_))]
    if near.any() and not near.all():
        sets.append(("the base fits, within reach", near))
    figure = new_figure(12 if len(sets) > 1 else 9, 4.1)
    *maps, distances = figure.subplots(1, len(sets) + 1).tolist()
    half_m = float(np.abs(columns.offset_m).max()) + 0.1
    for ax, (name, rows) in zip(maps, sets, strict=True):
        _draw_cells(ax, columns, rows, half_m)
        ax.set_title(f"{name}: {100 * columns.label[rows].mean():.0f}% of {int(rows.sum()):,} good")
    figure.colorbar(ScalarMappable(Normalize(0, 1), SCORE_COLOURS), ax=maps, shrink=0.75)
    _draw_distances(distances, columns, sets)
    return figure


def _draw_cells(ax: Axes, columns: RunColumns, rows: Bools, half_m: float) -> None:
    x, y = columns.offset_m[rows].T
    # A run of a few scenes has larger cells, so that most have candidates enough.
    size = int(np.clip(2 * half_m / _CELL_M, 6, max(6, (len(x) / _FEWEST) ** 0.5)))
    edges = (-half_m, half_m, -half_m, half_m)
    look: dict[str, Any] = {"cmap": SCORE_COLOURS, "vmin": 0, "vmax": 1, "linewidths": 0.2}
    ax.hexbin(
        x,
        y,
        columns.label[rows],
        reduce_C_function=np.mean,
        gridsize=size,
        extent=edges,
        mincnt=_FEWEST,
        **look,
    )
    ax.plot(0, 0, "o", ms=9, color=TARGET.colour, mec=TARGET.edge)
    ax.annotate(
        CAMERA.words,
        (0, -half_m),
        (0, 4),
        textcoords="offset points",
        ha="center",
        fontsize=9,
        color="#555555",
    )
    ax.set(xlim=edges[:2], ylim=edges[2:], xlabel="to the right of the target (m)", ylabel="behind it (m)")
    ax.set_aspect("equal")
    ax.set_facecolor("#f3f3f3")


def _draw_distances(ax: Axes, columns: RunColumns, sets: Sequence[tuple[str, Bools]]) -> None:
    edges = np.arange(0, float(columns.distance_m.max()) + _CELL_M, _CELL_M)
    middles, counts = (edges[1:] + edges[:-1]) / 2, np.histogram(columns.distance_m, edges)[0]
    bars = ax.twinx()
    bars.bar(middles, counts, 0.9 * _CELL_M, color="#e3e7ec", zorder=0)
    bars.set(ylim=(0, 2 * max(1, int(counts.max()))), ylabel="candidates")
    ax.set_zorder(bars.get_zorder() + 1)
    ax.patch.set_visible(False)
    for (name, rows), colour, line in zip(
        sets, (LABEL_STYLES[1].colour, LABEL_STYLES[0].colour), ("o-", "s--"), strict=False
    ):
        count = np.histogram(columns.distance_m[rows], edges)[0]
        good = np.histogram(columns.distance_m[rows & columns.label], edges)[0]
        share = np.where(count > 0, good / np.maximum(count, 1), np.nan)
        ax.plot(middles, share, line, color=colour, ms=4, label=name)
    ax.set(
        xlabel="distance from the target (m)",
        ylabel="share of good base poses",
        ylim=(0, 1.25),
        yticks=np.linspace(0, 1, 6),
    )
    ax.legend(frameon=False, fontsize=9, loc="upper right")


def draw_history(history: Sequence[Mapping[str, Any]], best_epoch: int | None) -> Figure:
    """Draw loss and accuracy of training and validation by epoch."""
    figure = new_figure(12, 3.4)
    epochs = [record["epoch"] for record in history]
    for ax, name in zip(figure.subplots(1, 2), ("loss", "accuracy"), strict=True):
        for key, words, colour, line in (
            (name, "training", MODEL_COLOURS[0], "o--"),
            (f"val_{name}", "validation", MODEL_COLOURS[1], "s-"),
        ):
            ax.plot(epochs, [record[key] for record in history], line, ms=4, color=colour, label=words)
        if best_epoch is not None:
            ax.axvline(best_epoch, color="#999999", lw=0.8, ls=":")
        ax.set(title=name, xlabel="epoch; the dotted line is the best")
        ax.grid(color="#e4e4e4", lw=0.7)
        ax.legend(frameon=False, fontsize=9)
    return figure
