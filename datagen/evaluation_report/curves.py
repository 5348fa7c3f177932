"""Figures of an evaluation: intervals, ROC, precision and recall, reliability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from datagen.evaluation_report.number_format import METRIC_WORDS, Report, paper_accuracy
from datagen.evaluation_report.svg import LINES, new_figure
from datagen.schemas.styles import BASELINE_COLOURS, BASELINE_MARKERS, MODEL_COLOURS, MODEL_MARKERS

_SHOWN = ("accuracy", "balanced_accuracy", "area_under_roc", "best_pick")


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


def draw_intervals(report: Report, told: Report) -> Figure:
    """Draw each method as a dot with its interval, by metric; the paper's accuracy as a bar."""
    records = report["methods"]
    figure = new_figure(12, 1.1 + 0.36 * len(records))
    looks = looks_of(records)
    panels = figure.subplots(1, len(_SHOWN), sharey=True, squeeze=False)[0]
    for ax, metric in zip(panels, _SHOWN, strict=True):
        for y, record in enumerate(records):
            estimate = told["methods"][record["name"]][metric]
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
    panels[0].set_yticks(range(len(records)), [r["name"] for r in records])
    panels[0].invert_yaxis()
    return figure


def _draw_estimate(ax: Axes, y: int, estimate: Report, look: dict[str, Any]) -> None:
    if estimate["value"] is None:
        return
    if estimate["low"] is not None and estimate["high"] is not None:
        ax.plot([100 * estimate["low"], 100 * estimate["high"]], [y, y], color=look["color"], lw=3, alpha=0.5)
    ax.plot(100 * estimate["value"], y, look["marker"], color=look["color"], mec="white", mew=0.6, ms=8)


def draw_curves(report: Report, told: Report) -> Figure:
    """Draw ROC, precision-recall and reliability curves of every method side by side."""
    records = report["methods"]
    figure = new_figure(12, 5.6)
    roc, pr, reliability = figure.subplots(1, 3)
    looks = looks_of(records)
    for k, record in enumerate(records):
        name = record["name"]
        # Markers stand at other places on each curve, so that no two of them hide each other.
        look = looks[name] | {"ms": 6, "mec": "white", "mew": 0.5}
        spread = look | {"markevery": (0.02 + 0.14 * (k % 8) / 8, 0.14)}
        curves, methods = told["curves"][name], told["methods"][name]
        area = methods["area_under_roc"]["value"]
        roc.plot(curves["roc"]["x"], curves["roc"]["y"], **spread, label=f"{name} ({area:.2f})")
        precision = curves["precision_recall"]
        words = f"{name} ({curves['average_precision']:.2f})"
        pr.step(precision["x"], precision["y"], where="pre", **spread, label=words)
        if methods["reliability"]:
            said, true = ([bin_[key] for bin_ in methods["reliability"]] for key in ("said", "true"))
            sizes = [bin_["count"] for bin_ in methods["reliability"]]
            reliability.plot(said, true, **look | {"marker": ""})
            area_pt2 = [14 + 160 * n / max(sizes) for n in sizes]
            reliability.scatter(said, true, s=area_pt2, color=look["color"], marker=look["marker"], alpha=0.7)
            reliability.plot([], [], **look, label=f"{name} ({methods['brier']:.3f})")
    share = told["positives"] / told["count"]
    pr.axhline(share, color="#999999", lw=0.8, ls=":")
    for ax in (roc, reliability):
        ax.plot([0, 1], [0, 1], color="#999999", lw=0.8, ls=":")
    for ax, title, x, y in (
        (roc, "ROC (area under the curve)", "false positive rate", "true positive rate"),
        (pr, "precision and recall (average precision)", "recall", "precision"),
        (reliability, "reliability (Brier score)", "mean predicted probability", "observed share of good"),
    ):
        ax.set(title=title, xlabel=x, ylabel=y, xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False, ncols=2)
    return figure
