"""The frontier as a picture: accuracy against the cost of labels, a line for each mixture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from datagen.display.styles import MODEL_COLOURS, MODEL_MARKERS
from datagen.frontier.points import METRICS, Point, efficient

_WORDS = {"balanced_accuracy": "balanced accuracy within reach (%)", "area_under_roc": "AUC within reach (%)"}


def draw_frontier(points: Sequence[Point], currency: str, file: Path) -> None:
    """Write the picture; the ending of `file` chooses its format."""
    metadata = {"Date": None} if file.suffix == ".svg" else None
    frontier_figure(points, currency).savefig(file, metadata=metadata)


def frontier_figure(points: Sequence[Point], currency: str) -> Figure:
    """The picture, a panel for each metric."""
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    panels = figure.subplots(1, len(METRICS))
    names = list(dict.fromkeys(point.mixture.name for point in points))
    for ax, metric in zip(panels, METRICS, strict=True):
        for k, name in enumerate(names):
            _draw_line(ax, [point for point in points if point.mixture.name == name], metric, k)
        _ring_efficient(ax, points, metric)
        ax.set(xscale="log", xlabel="core-hours of labels", ylabel=_WORDS[metric])
        low, high = ax.get_xlim()
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * low else (1,)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.grid(color="#e4e4e4", lw=0.7)
        ax.set_axisbelow(True)
    dearest = max(points, key=lambda point: point.cpu_h)
    rate = dearest.money / dearest.cpu_h if dearest.cpu_h else 0.0
    handles, words = panels[0].get_legend_handles_labels()
    title = f"trained on, in this order; 1 core-hour of labels costs about {rate:.3g} {currency}"
    figure.legend(handles, words, loc="outside lower center", ncols=4, frameon=False, title=title)
    return figure


def _draw_line(ax: Axes, points: Sequence[Point], metric: str, k: int) -> None:
    ordered = sorted(points, key=lambda point: point.cpu_h)
    x = [point.cpu_h for point in ordered]
    y = np.array([point.values[metric].value for point in ordered])
    low, high = np.array([point.values[metric].interval() for point in ordered]).T
    # The percentile interval need not hold the value itself.
    bars = 100 * np.maximum([y - low, high - y], 0)
    colour, marker = MODEL_COLOURS[k % len(MODEL_COLOURS)], MODEL_MARKERS[k % len(MODEL_MARKERS)]
    style = "-" if k < len(MODEL_COLOURS) else "--"
    ax.errorbar(
        x, 100 * y, bars, color=colour, marker=marker, ls=style, lw=1.4, ms=6, elinewidth=0.8, capsize=2,
        label=ordered[0].mixture.name,
    )  # fmt: skip


def _ring_efficient(ax: Axes, points: Sequence[Point], metric: str) -> None:
    best = [p for p, is_best in zip(points, efficient(points, metric), strict=True) if is_best]
    ax.plot(
        [p.cpu_h for p in best],
        [100 * p.values[metric].value for p in best],
        ls="",
        marker="o",
        ms=13,
        mfc="none",
        mec="#000000",
        label="on the frontier",
    )
