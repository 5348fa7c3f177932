"""An evaluation as tables on a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from datagen.console.printing import print_rows
from datagen.evaluating.wording import (
    METRIC_WORDS,
    candidates_line,
    compared,
    grids_line,
    method_label,
    metres_with_interval,
    models_first,
    paper_accuracy,
    percent,
    with_interval,
)

_MOST_COLUMNS = 5  # of methods in a breakdown

Report = Mapping[str, Any]


def print_evaluation(report: Report) -> None:
    """Tables I to III with the paper's numbers, calibration and breakdowns."""
    for part in report["parts"]:
        if len(report["parts"]) > 1 or part["houses"] == "seen":
            trained = "that were trained on" if part["houses"] == "seen" else "that nobody was trained on"
            print_rows(f"{part['scenes']:,} scenes in houses {trained}", [])
        for told in part["sets"].values():
            _print_accuracy(report, told)
        for name, why in part["left_out"].items():
            print_rows(f"Table I: {name} is left out", [("", why)])
        for told in part["sets"].values():
            _print_reach(report, told)
        _print_grids(report, part)
        for told in part["sets"].values():
            _print_calibration(report, told)
        # The narrowest set is the one on which methods differ.
        for told in list(part["sets"].values())[:1]:
            _print_breakdown(report, told)
    notes = [
        ("intervals", f"95% by {report['bootstrap']['resamples']:,} resamples of scenes"),
        ("paper", f"{report['paper']['source']}: other houses, arms and candidates"),
    ]
    if any(record["threshold"] is None for record in report["methods"]):
        notes.append(("*", "has no threshold: its pick of a robot's candidates is good, all others are bad"))
    notes += [(record["name"], record["note"]) for record in report["methods"] if record["note"]]
    notes += [(name, f"left out: {why}") for name, why in report["left_out"].items()]
    print_rows("notes", notes)


def _print_accuracy(report: Report, told: Report) -> None:
    metrics = [metric for metric in METRIC_WORDS if metric != "good"]
    rows = [
        (
            method_label(record),
            *(
                with_interval(told["methods"][record["name"]][metric])
                for metric in METRIC_WORDS
                if metric != "good"
            ),
            percent(paper_accuracy(record, report["paper"])),
        )
        for record in report["methods"]
    ]
    heads = ("method", *(METRIC_WORDS[metric] for metric in metrics), "paper")
    print_rows(f"Table I: {candidates_line(told)}", rows, heads)
    _print_order(report, told["differences"], ("accuracy", "balanced_accuracy"), told["candidates"])


def _print_order(report: Report, differences: Sequence[Report], metrics: Sequence[str], where: str) -> None:
    """Whom each model is above and below; of baselines alone, each of them."""
    models = [r for r in report["methods"] if r["regime"]] or report["methods"]
    for metric in metrics:
        rows = [
            (record["name"], *("; ".join(names) or "-" for names in said.values()))
            for record in models
            if any((said := compared(differences, metric, record["name"])).values())
        ]
        if rows:
            title = f"by {METRIC_WORDS[metric]} ({where}): + where the two intervals are disjoint as well"
            print_rows(title, rows, ("method", "above", "not told apart from", "below"))


def _print_reach(report: Report, told: Report) -> None:
    inside, outside = told["in_reach"], told["out_of_reach"]
    if not outside["count"]:
        return
    rows = [
        (
            method_label(record),
            with_interval(told["methods"][record["name"]]["accuracy_in_reach"]),
            with_interval(told["methods"][record["name"]]["accuracy_out_of_reach"]),
            percent(paper_accuracy(record, report["paper"])) if record["regime"] else "-",
            percent(report["paper"]["accuracy_out_of_reach"]) if record["regime"] == "two-stage" else "-",
        )
        for record in models_first(report["methods"])
    ]
    title = (
        f"Table II: {told['candidates']}, {inside['count']:,} within reach and {outside['count']:,} beyond"
    )
    print_rows(title, rows, ("method", "R_in", "R_out", "paper, all", "paper, R_out"))


def _print_grids(report: Report, part: Report) -> None:
    grids = part["grids"]
    if grids is None:
        print_rows("Table III: left out", [("", part["no_grids"])])
        return
    rows = [
        (
            record["name"],
            with_interval(grids["methods"][record["name"]]["good"]),
            metres_with_interval(grids["methods"][record["name"]]["missed_m"]),
            f"{record['seconds_per_600']:.2g}",
        )
        for record in models_first(report["methods"])
    ]
    paper = report["paper"]
    rows.append(("any clear candidate", percent(grids["any_clear"]), "-", "-"))
    rows.append(("paper, two-stage", percent(paper["grid_selection"]), f"{paper['grid_miss_m']:.2f}",
                 f"{paper['seconds_per_600']:g}"))  # fmt: skip
    title = f"Table III: {grids_line(grids)}"
    print_rows(title, rows, ("method", "best clear one good", "else missed by (m)", "s per 600"))
    _print_order(report, grids["differences"], ("good",), "whole grids")


def _print_calibration(report: Report, told: Report) -> None:
    rows = [
        (record["name"], f"{said['brier']:.3f}", f"{said['expected_calibration_error']:.3f}")
        for record in report["methods"]
        if (said := told["methods"][record["name"]])["brier"] is not None
    ]
    if rows:
        title = f"probabilities ({told['candidates']})"
        print_rows(title, rows, ("method", "Brier score", "expected calibration error"))


def _print_breakdown(report: Report, told: Report) -> None:
    shown = models_first(report["methods"])[:_MOST_COLUMNS]
    headings = dict.fromkeys(row["by"] for row in told["breakdown"])
    for heading in headings:
        rows = [
            (
                row["group"],
                f"{row['count']:,}",
                percent(row["positives"] / row["count"]),
                *(percent(row["methods"][record["name"]]["accuracy"]) for record in shown),
            )
            for row in told["breakdown"]
            if row["by"] == heading
        ]
        heads = (heading, "count", "good", *(record["name"] for record in shown))
        print_rows(f"accuracy by {heading} ({told['candidates']})", rows, heads)
