"""Figures of an evaluation: intervals, ROC, precision and recall, reliability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from datagen.evaluating.svg import BASELINE_COLOURS, LINES, MODEL_COLOURS, new_figure
from datagen.evaluating.wording import METRIC_WORDS, Report, paper_accuracy

_SHOWN = ("accuracy", "balanced_accuracy", "area_under_roc", "best_pick")


def looks_of(records: Sequence[Report]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each method: solid for models, dashed for baselines."""
    looks: dict[str, dict[str, Any]] = {}
    models = baselines = 0
    for record in records:
        if record["regime"] is None:
            colour, line, width = BASELINE_COLOURS[baselines % 8], LINES[baselines % 3], 1.3
            baselines += 1
        else:
            colour, line, width = MODEL_COLOURS[models % 6], "-", 2.4
            models += 1
        looks[record["name"]] = {"color": colour, "ls": line, "lw": width}
    return looks


def draw_intervals(report: Report, told: Report) -> Figure:
    """Draw each method as a dot with its interval, by metric; the paper's accuracy as a diamond."""
    records = report["methods"]
    figure = new_figure(12, 1.1 + 0.34 * len(records))
    looks = looks_of(records)
    panels = figure.subplots(1, len(_SHOWN), sharey=True, squeeze=False)[0]
    for ax, metric in zip(panels, _SHOWN, strict=True):
        for y, record in enumerate(records):
            estimate = told["methods"][record["name"]][metric]
            _draw_estimate(ax, y, estimate, looks[record["name"]]["color"])
            stated = paper_accuracy(record, report["paper"])
            if metric == "accuracy" and stated is not None:
                ax.plot(100 * stated, y, "D", ms=6, mfc="none", mec="black")
        if metric in ("balanced_accuracy", "area_under_roc"):
            ax.axvline(50, color="#999999", lw=0.8, ls=":")
        mark = ", ◇ the paper" if metric == "accuracy" else ""
        ax.set_xlabel(f"{METRIC_WORDS[metric]} (%){mark}")
        ax.grid(axis="x", color="#e4e4e4", lw=0.7)
        ax.set_axisbelow(True)
        for side in ("top", "right", "left"):
            ax.spines[side].set_visible(False)
    panels[0].set_yticks(range(len(records)), [r["name"] for r in records])
    panels[0].invert_yaxis()
    return figure


def _draw_estimate(ax: Axes, y: int, estimate: Report, colour: str) -> None:
    if estimate["value"] is None:
        return
    if estimate["low"] is not None and estimate["high"] is not None:
        ax.plot([100 * estimate["low"], 100 * estimate["high"]], [y, y], color=colour, lw=3, alpha=0.55)
    ax.plot(100 * estimate["value"], y, "o", color=colour, ms=6)


def draw_curves(report: Report, told: Report) -> Figure:
    """Draw ROC, precision-recall and reliability curves of every method side by side."""
    records = report["methods"]
    figure = new_figure(13, 4.9)
    roc, pr, reliability = figure.subplots(1, 3)
    looks = looks_of(records)
    for record in records:
        name = record["name"]
        curves, methods = told["curves"][name], told["methods"][name]
        area = methods["area_under_roc"]["value"]
        roc.plot(curves["roc"]["x"], curves["roc"]["y"], **looks[name], label=f"{name} ({area:.2f})")
        precision = curves["precision_recall"]
        words = f"{name} ({curves['average_precision']:.2f})"
        pr.step(precision["x"], precision["y"], where="pre", **looks[name], label=words)
        if methods["reliability"]:
            said, true = ([bin_[k] for bin_ in methods["reliability"]] for k in ("said", "true"))
            sizes = [bin_["count"] for bin_ in methods["reliability"]]
            reliability.plot(said, true, **looks[name], label=f"{name} ({methods['brier']:.3f})")
            area_pt2 = [12 + 160 * n / max(sizes) for n in sizes]
            reliability.scatter(said, true, s=area_pt2, color=looks[name]["color"], alpha=0.6)
    share = told["positives"] / told["count"]
    pr.axhline(share, color="#999999", lw=0.8, ls=":")
    for ax in (roc, reliability):
        ax.plot([0, 1], [0, 1], color="#999999", lw=0.8, ls=":")
    for ax, title, x, y in (
        (roc, "ROC (area)", "false positive rate", "true positive rate"),
        (pr, "precision and recall (average)", "recall", "precision"),
        (reliability, "reliability (Brier score)", "mean prediction", "observed rate"),
    ):
        ax.set(title=title, xlabel=x, ylabel=y, xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, -0.16), frameon=False, ncols=2)
    return figure
