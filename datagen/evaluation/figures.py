"""Figures of an evaluation: intervals, success on arrival, and whole grids of a few scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from datagen.display.figures import new_figure, plain
from datagen.display.styles import (
    BASELINE_COLOURS,
    BASELINE_MARKERS,
    BEST,
    CELL_COLOURS,
    MODEL_COLOURS,
    MODEL_MARKERS,
    SCORE_COLOURS,
)
from datagen.evaluation.columns import Columns
from datagen.evaluation.grids import AT_RANDOM, BY_LABELS, PICKS, picks
from datagen.evaluation.report_tables import METRIC_WORDS, Report, models_first, paper_accuracy
from datagen.train.inputs import F64, I64

_SHOWN = ("accuracy", "balanced_accuracy", "area_under_roc", "best_pick")
_MOST_METHODS, _MOST_EXAMPLES = 5, 4
_PANEL_IN = 2.55
_TRUTH = ListedColormap(CELL_COLOURS)
_REACH_COLOUR = "#1b3a6b"
_LOOP_TITLES = {
    "nominal": "pick with the best score",
    "smoothed": "pick with the best mean score on arrival",
}
_APART_CM = 0.12  # between two methods, so that their intervals do not hide each other
INTERVALS_CAPTION = (
    "Each method with its interval; a black bar is the accuracy in the paper, a dotted line chance."
)
LOOP_CAPTION = "Success where the robot arrives off its pick and plans from there, with intervals by scene."
GRIDS_CAPTION = (
    "Scenes drawn at random from those with a good base pose, seen from above; x and y are relative to the "
    "target. Truth: blue is good, pale orange is bad, grey is where the base collides. Methods: their scores "
    "where the base fits, from red (lowest) to blue (highest). The pick is a gold star where it is good, a "
    "white cross where it is bad. The dashed circle is the arm's reach; the target is at the cross."
)


def draw_intervals(report: Report, scores: Report) -> Figure:
    """Draw each method as a dot with its interval, by metric; the paper's accuracy as a bar."""
    records = report["methods"]
    figure = new_figure(12, 1.1 + 0.36 * len(records))
    looks = _looks_of(records)
    panels = figure.subplots(1, len(_SHOWN), sharey=True, squeeze=False)[0]
    for ax, metric in zip(panels, _SHOWN, strict=True):
        for y, record in enumerate(records):
            _draw_estimate(ax, y, scores["methods"][record["name"]][metric], looks[record["name"]])
            stated = paper_accuracy(record, report)
            if metric == "accuracy" and stated is not None:
                ax.plot(100 * stated, y, "|", ms=16, mew=2, color="black")
        if metric in ("balanced_accuracy", "area_under_roc"):
            ax.axvline(50, color="#999999", lw=0.8, ls=":")
        ax.set_xlabel(f"{METRIC_WORDS[metric]} (%)")
        ax.grid(axis="x", color="#e4e4e4", lw=0.7)
        ax.set_axisbelow(True)
        ax.spines[["top", "right", "left"]].set_visible(False)
    panels[0].set_yticks(range(len(records)), [plain(r["name"]) for r in records])
    panels[0].invert_yaxis()
    return figure


def _looks_of(records: Sequence[Report]) -> dict[str, dict[str, Any]]:
    """Colour, marker and line of each method: solid for models, dashed for baselines."""
    looks: dict[str, dict[str, Any]] = {}
    for is_model, colours, markers, lines, width in (
        (True, MODEL_COLOURS, MODEL_MARKERS, ("-",), 2.0),
        (False, BASELINE_COLOURS, BASELINE_MARKERS, ("--", "-.", ":"), 1.2),
    ):
        names = [record["name"] for record in records if (record["regime"] is not None) is is_model]
        for k, name in enumerate(names):
            colour, marker = colours[k % len(colours)], markers[k % len(markers)]
            looks[name] = {"color": colour, "marker": marker, "ls": lines[k % len(lines)], "lw": width}
    return looks


def _draw_estimate(ax: Axes, y: int, estimate: Report, look: dict[str, Any]) -> None:
    if estimate["value"] is None:
        return
    if estimate["low"] is not None and estimate["high"] is not None:
        ax.plot([100 * estimate["low"], 100 * estimate["high"]], [y, y], color=look["color"], lw=3, alpha=0.5)
    ax.plot(100 * estimate["value"], y, look["marker"], color=look["color"], mec="white", mew=0.6, ms=8)


def draw_loop(report: Report) -> Figure:
    """Draw success against arrival error: a panel for each kind of pick, a line for each method."""
    part = report["closed_loop"]["parts"][0]
    figure = new_figure(11, 5.6)
    panels = figure.subplots(1, len(PICKS), sharey=True)
    plain_look = {"marker": "", "ls": ":", "lw": 1.6}
    looks = _looks_of(report["methods"])
    looks |= {BY_LABELS: {"color": "#000000"} | plain_look, AT_RANDOM: {"color": "#999999"} | plain_look}
    for ax, pick in zip(panels, PICKS, strict=True):
        for k, (name, look) in enumerate(looks.items()):
            # The random choice ignores scores: it is the same in both panels.
            rates = [row["methods"][name].get(pick, row["methods"][name]["nominal"]) for row in part["table"]]
            x_cm = [100 * row["distance_m"] + _APART_CM * (k - len(looks) / 2) for row in part["table"]]
            _draw_line(ax, np.array(x_cm), rates, look, name)
        ax.set(title=_LOOP_TITLES[pick], xlabel="distance of the arrival from the pick (cm)", ylim=(-2, 102))
        ax.grid(color="#e4e4e4", lw=0.7)
        ax.set_axisbelow(True)
    panels[0].set_ylabel("success (%)")
    handles, words = panels[0].get_legend_handles_labels()
    figure.legend(handles, words, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _draw_line(
    ax: Axes, x_cm: F64, rates: Sequence[Mapping[str, Any]], look: dict[str, Any], name: str
) -> None:
    order = np.argsort(x_cm, kind="stable")
    y, low, high = 100 * np.array([[rates[k][key] for k in order] for key in ("value", "low", "high")], float)
    bars = np.maximum([y - low, high - y], 0)
    look = {**look, "ms": 6, "mec": "white", "mew": 0.5}
    ax.errorbar(x_cm[order], y, bars, elinewidth=0.8, capsize=2, label=plain(name), **look)


def example_scenes(columns: Columns) -> I64:
    """A few random scenes with whole grids and a good candidate."""
    positives = np.bincount(columns.scene, columns.label, columns.n_scenes)
    scenes = np.flatnonzero(columns.is_grid & (positives > 0))
    return np.random.default_rng(0).permutation(scenes)[:_MOST_EXAMPLES]


def draw_examples(scenes: I64, columns: Columns, records: Sequence[Report]) -> Figure:
    """One row per scene: the truth, and the scores and picks of up to five methods."""
    names = [record["name"] for record in models_first(records)][:_MOST_METHODS]
    figure = new_figure(_PANEL_IN * (1 + len(names)), 0.55 + _PANEL_IN * len(scenes) * 1.08)
    panels = figure.subplots(len(scenes), 1 + len(names), squeeze=False)
    for row, scene in enumerate(scenes):
        grid = columns.at(columns.scene == scene)
        truth, *scored = panels[row].tolist()
        _draw_truth(truth, grid)
        truth.set_ylabel(f"{columns.target[scene]}\ny [m]", fontsize=9)
        for ax, name in zip(scored, names, strict=True):
            _draw_scores(ax, grid, grid.scores[name])
    for ax, title in zip(panels[0], ("truth", *map(plain, names)), strict=True):
        ax.set_title(title, fontsize=10)
    for ax in panels[-1]:
        ax.set_xlabel("x [m]", fontsize=9)
    for ax in panels.ravel():
        ax.set_aspect("equal")
        ax.locator_params(nbins=3)
        ax.tick_params(labelsize=8)
        ax.label_outer()
    return figure


def _draw_image(ax: Axes, grid: Columns, values: F64, **look: Any) -> None:
    """Draw values (N,) as an image; the N candidates fill a square grid."""
    side = round(len(grid) ** 0.5)
    low, high = grid.base_xy_m.min(axis=0), grid.base_xy_m.max(axis=0)
    half = (high - low) / (2 * max(side - 1, 1))
    (left, bottom), (right, top) = (low - half).tolist(), (high + half).tolist()
    # Cells of a row have equal y except for float32 rounding.
    by_y = np.argsort(grid.base_xy_m[:, 1], kind="stable").reshape(side, side)
    by_x = np.take_along_axis(by_y, np.argsort(grid.base_xy_m[by_y, 0], axis=1, kind="stable"), axis=1)
    extent = (left, right, bottom, top)
    ax.imshow(values[by_x], origin="lower", extent=extent, interpolation="nearest", **look)


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
    # The first of several best scores is shown, with their number.
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
    """Draw the horizontal distance (m) within which the arm reaches the target."""
    reach_m, mount_m, planar_m = (float(a[0]) for a in (grid.reach_m, grid.mount_distance_m, grid.distance_m))
    left_m2 = reach_m**2 - max(mount_m**2 - planar_m**2, 0.0)
    if left_m2 > 0:
        circle = Circle((0, 0), left_m2**0.5, fill=False, ls="--", lw=1, edgecolor=_REACH_COLOUR)
        ax.add_patch(circle)
