"""Figures of an evaluation as inline SVG: intervals, curves, and whole grids of a few scenes."""

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

from datagen.display.figures import new_figure, plain
from datagen.display.styles import (
    BASELINE_COLOURS,
    BASELINE_MARKERS,
    BEST,
    CELL_COLOURS,
    MODEL_COLOURS,
    MODEL_MARKERS,
    SCORE_COLOURS,
    TARGET,
)
from datagen.evaluation_report.report_tables import METRIC_WORDS, Report, paper_accuracy
from datagen.train.evaluation.columns import Columns, Example
from datagen.train.evaluation.grids import picks

_SHOWN = ("accuracy", "balanced_accuracy", "area_under_roc", "best_pick")


LINES = ("--", "-.", ":")
_MOST_METHODS = 5
_PANEL_IN = 2.55
# In the legend of the curves, with its value in brackets: longer ones would run into the next curves' legend.
_LONGEST_IN_TWO_COLUMNS = 17
_TRUTH = ListedColormap(CELL_COLOURS)
_REACH_COLOUR = "#1b3a6b"
GRIDS_CAPTION = (
    "Scenes drawn at random from those with a good base pose, seen from above; x and y are relative to the "
    "target. Truth: blue is good, pale orange is bad, grey is where the base collides. Methods: their scores "
    "where the base fits, from red (lowest) to blue (highest). The pick is a gold star where it is good, a "
    "white cross where it is bad. The dashed circle is the arm's reach; the target's points are pink."
)
F64 = npt.NDArray[np.float64]


def looks_of(records: Sequence[Report]) -> dict[str, dict[str, Any]]:
    """Colour, marker and line of each method: solid for models, dashed for baselines."""
    looks: dict[str, dict[str, Any]] = {}
    models = baselines = 0
    for record in records:
        if record["regime"] is None:
            k, n = baselines, len(BASELINE_COLOURS)
            look = (BASELINE_COLOURS[k % n], BASELINE_MARKERS[k % n], LINES[k % len(LINES)], 1.2)
            baselines += 1
        else:
            k, n = models, len(MODEL_COLOURS)
            look = (MODEL_COLOURS[k % n], MODEL_MARKERS[k % n], "-", 2.0)
            models += 1
        looks[record["name"]] = dict(zip(("color", "marker", "ls", "lw"), look, strict=True))
    return looks


def draw_intervals(report: Report, scores: Report) -> Figure:
    """Draw each method as a dot with its interval, by metric; the paper's accuracy as a bar."""
    records = report["methods"]
    figure = new_figure(12, 1.1 + 0.36 * len(records))
    looks = looks_of(records)
    panels = figure.subplots(1, len(_SHOWN), sharey=True, squeeze=False)[0]
    for ax, metric in zip(panels, _SHOWN, strict=True):
        for y, record in enumerate(records):
            estimate = scores["methods"][record["name"]][metric]
            _draw_estimate(ax, y, estimate, looks[record["name"]])
            stated = paper_accuracy(record, report["paper"])
            if metric == "accuracy" and stated is not None:
                ax.plot(100 * stated, y, "|", ms=16, mew=2, color="black")
        if metric in ("balanced_accuracy", "area_under_roc"):
            ax.axvline(50, color="#999999", lw=0.8, ls=":")
        mark = ", | the paper" if metric == "accuracy" else ""
        ax.set_xlabel(f"{METRIC_WORDS[metric]} (%){mark}")
        ax.grid(axis="x", color="#e4e4e4", lw=0.7)
        ax.set_axisbelow(True)
        for side in ("top", "right", "left"):
            ax.spines[side].set_visible(False)
    panels[0].set_yticks(range(len(records)), [plain(r["name"]) for r in records])
    panels[0].invert_yaxis()
    return figure


def _draw_estimate(ax: Axes, y: int, estimate: Report, look: dict[str, Any]) -> None:
    if estimate["value"] is None:
        return
    if estimate["low"] is not None and estimate["high"] is not None:
        ax.plot([100 * estimate["low"], 100 * estimate["high"]], [y, y], color=look["color"], lw=3, alpha=0.5)
    ax.plot(100 * estimate["value"], y, look["marker"], color=look["color"], mec="white", mew=0.6, ms=8)


def draw_curves(report: Report, scores: Report) -> Figure:
    """Draw ROC, precision-recall and reliability curves of every method side by side."""
    records = report["methods"]
    figure = new_figure(12, 5.6)
    roc, pr, reliability = figure.subplots(1, 3)
    looks = looks_of(records)
    for k, record in enumerate(records):
        name = record["name"]
        # Each curve has its markers at other positions, so that they do not hide each other.
        look = looks[name] | {"ms": 6, "mec": "white", "mew": 0.5}
        spread = look | {"markevery": (0.02 + 0.14 * (k % 8) / 8, 0.14)}
        curves, methods = scores["curves"][name], scores["methods"][name]
        area = methods["area_under_roc"]["value"]
        roc.plot(curves["roc"]["x"], curves["roc"]["y"], **spread, label=f"{plain(name)} ({area:.2f})")
        precision = curves["precision_recall"]
        words = f"{plain(name)} ({curves['average_precision']:.2f})"
        pr.step(precision["x"], precision["y"], where="pre", **spread, label=words)
        if methods["reliability"]:
            predicted, observed = ([bin_[key] for bin_ in methods["reliability"]] for key in ("said", "true"))
            sizes = [bin_["count"] for bin_ in methods["reliability"]]
            reliability.plot(predicted, observed, **look | {"marker": ""})
            area_pt2 = [14 + 160 * n / max(sizes) for n in sizes]
            reliability.scatter(
                predicted, observed, s=area_pt2, color=look["color"], marker=look["marker"], alpha=0.7
            )
            reliability.plot([], [], **look, label=f"{plain(name)} ({methods['brier']:.3f})")
    share = scores["positives"] / scores["count"]
    pr.axhline(share, color="#999999", lw=0.8, ls=":")
    for ax in (roc, reliability):
        ax.plot([0, 1], [0, 1], color="#999999", lw=0.8, ls=":")
    for ax, title, x, y in (
        (roc, "ROC (area under the curve)", "false positive rate", "true positive rate"),
        (pr, "precision and recall (average precision)", "recall", "precision"),
        (reliability, "reliability (Brier score)", "mean predicted probability", "observed share of good"),
    ):
        ax.set(title=title, xlabel=x, ylabel=y, xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
        if labels := ax.get_legend_handles_labels()[1]:
            columns = 2 if max(map(len, labels)) <= _LONGEST_IN_TWO_COLUMNS else 1
            ax.legend(
                fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False, ncols=columns
            )
    return figure


def draw_examples(
    examples: Sequence[Example], columns: Columns, records: Sequence[Mapping[str, Any]]
) -> Figure:
    """One row per scene: the cloud from above, the truth, and the scores and picks of up to five methods."""
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
