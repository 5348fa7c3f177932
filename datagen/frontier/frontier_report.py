"""A frontier as one JSON document, and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from datagen.console.printing import print_lines, print_rows, seconds
from datagen.frontier.advice_text import advice_text, target_text
from datagen.frontier.buyer import Purchase
from datagen.frontier.points import METRICS, efficient
from datagen.frontier.study import JUDGED, Study, estimate_record, gain_record
from datagen.reports.prices import Prices
from datagen.train.evaluation.bootstrap import Estimate

Record = dict[str, Any]


def frontier_record(study: Study, prices: Prices, budget_cpu_h: float, data: Mapping[str, Any]) -> Record:
    """All numbers as plain values. `data`: the runs and the test set."""
    on_frontier = {metric: efficient(study.points, metric) for metric in METRICS}
    advice, curve = study.advice, study.joint.get(JUDGED)
    sentences = [advice_text(advice, budget_cpu_h)] if advice else []
    if study.target and curve:
        sentences.append(target_text(study.target, curve))
    return {
        **data,
        "currency": prices.currency,
        "prices": prices.record(),
        "label_costs": {n: {"cpu_s": c.cpu_s, "money": c.money} for n, c in study.costs.items()},
        "points": [
            {
                "trained_on": point.mixture.name,
                "stages": [[stage.source, stage.share] for stage in point.mixture.stages],
                "seeds": point.seeds,
                "labels": dict(point.labels),
                "label_cpu_h": point.cpu_h,
                "money": point.money,
                "train_cpu_s": point.train_cpu_s,
                **{metric: estimate_record(point.values[metric]) for metric in METRICS},
                "on_frontier": {metric: on_frontier[metric][k] for metric in METRICS},
            }
            for k, point in enumerate(study.points)
        ],
        "stage1": [gain_record(gain) for gain in study.stage1],
        "stage1_worth": study.stage1_worth and estimate_record(study.stage1_worth),
        "curves": {
            metric: {"parameters": curve.theta.tolist(), "residual": curve.residual}
            for metric, curve in study.joint.items()
        },
        "foretold": [
            {
                "trained_on": f.name,
                "measured": estimate_record(f.measured),
                "predicted": estimate_record(f.predicted),
            }
            for f in study.foretold
        ],
        "advice": advice
        and {
            "budget_cpu_h": budget_cpu_h,
            "best": advice.best,
            "wins": dict(advice.wins),
            "now": estimate_record(Estimate(advice.now, advice.now_resamples)),
            "alone": {name: _purchase(purchase) for name, purchase in advice.alone.items()},
            "best_split": _purchase(advice.split),
        },
        "target": study.target
        and {
            "accuracy": study.target.accuracy,
            "reached_by_half": study.target.reached_by_half and _purchase(study.target.reached_by_half),
            "reached_by_most": study.target.reached_by_most and _purchase(study.target.reached_by_most),
        },
        "sentences": sentences,
    }


def _purchase(purchase: Purchase) -> Record:
    expected = estimate_record(Estimate(purchase.accuracy, purchase.resamples))
    return {"labels": dict(purchase.labels), "cpu_h": purchase.cpu_h, "balanced_accuracy": expected}


def print_frontier(record: Record, files: Sequence[tuple[str, str]]) -> None:
    """Print the tables, then the advice."""
    currency = record["currency"]
    print_rows(
        "labels, from the ledgers",
        [
            (name, f"{1000 * cost['cpu_s']:.3g} ms", f"{1000 * cost['money']:.3g}")
            for name, cost in record["label_costs"].items()
        ],
        ("source", "CPU a label", f"{currency} per 1,000"),
    )
    test = record["test_set"]
    print_rows(
        f"on {test['candidates']:,} candidates within reach in {test['scenes']:,} test scenes "
        f"(percent [95% interval over seeds and scenes]; * on the frontier)",
        [_point_row(point) for point in record["points"]],
        ("trained on", "labels of the last", "label CPU", currency, "balanced accuracy", "AUC"),
    )
    print_rows(
        "stage 1 (all heuristic labels first), points of balanced accuracy",
        [
            (
                f"{round(gain['labels']):,} {gain['source']}",
                points_text(gain["same_labels"]),
                points_text(gain["same_cost"]) if gain["same_cost"] else "",
            )
            for gain in record["stage1"]
        ],
        ("before", "over the same labels alone", "over the same cost alone"),
    )
    print_rows(
        "largest sets, predicted by a curve of the smaller ones (balanced accuracy)",
        [
            (f["trained_on"], percent_text(f["predicted"]), percent_text(f["measured"]))
            for f in record["foretold"]
        ],
        ("trained on", "predicted", "measured"),
    )
    if advice := record["advice"]:
        rows = [
            (
                name,
                f"{purchase['labels'].get(name, 0):,}",
                percent_text(purchase["balanced_accuracy"]),
                f"{share:.0%}",
            )
            for name, purchase in advice["alone"].items()
            for share in (advice["wins"][name],)
        ]
        rows.append(
            (
                "best split",
                _split_text(advice["best_split"]),
                percent_text(advice["best_split"]["balanced_accuracy"]),
                "",
            )
        )
        print_rows(
            f"the next {advice['budget_cpu_h']:g} core-hours, from {percent_text(advice['now'])}",
            rows,
            ("spent on", "labels", "expected balanced accuracy", "best in"),
        )
    for sentence in record["sentences"]:
        print_lines(sentence)
    print_rows("written", list(files))


def _point_row(point: Record) -> tuple[str, ...]:
    last = point["stages"][-1][0]
    marks = {metric: " *" if point["on_frontier"][metric] else "  " for metric in METRICS}
    return (
        point["trained_on"],
        f"{round(point['labels'][last]):,}",
        seconds(3600 * point["label_cpu_h"]),
        f"{point['money']:.2g}",
        *(percent_text(point[metric]) + marks[metric] for metric in METRICS),
    )


def _split_text(purchase: Record) -> str:
    return " + ".join(f"{n:,} {name}" for name, n in purchase["labels"].items()) or "none"


def percent_text(estimate: Mapping[str, float | None]) -> str:
    """A share as 84.1 [83.0, 85.2]."""
    return _with_interval(estimate, "{:.1f}")


def points_text(difference: Mapping[str, float | None]) -> str:
    """A difference as +1.2 [-0.3, +2.5]."""
    return _with_interval(difference, "{:+.1f}")


def _with_interval(estimate: Mapping[str, Any], form: str) -> str:
    shown = ["-" if estimate[k] is None else form.format(100 * estimate[k]) for k in ("value", "low", "high")]
    return f"{shown[0]} [{shown[1]}, {shown[2]}]"
