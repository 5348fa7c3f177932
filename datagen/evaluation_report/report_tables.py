"""The tables of an evaluation, as a terminal and a page both show them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from datagen.evaluation_report.number_format import (
    METRIC_WORDS,
    Report,
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

DECISIONS = ("accuracy", "balanced_accuracy", "area_under_roc")
CHOICE = ("best_pick", "mean_average_precision")
TABLE_I = (*DECISIONS, *CHOICE)
TABLE_III = ("good", "mean_average_precision")
# What regimes are held against each other by.
_COMPARED = ("accuracy", "balanced_accuracy", "good", "mean_average_precision")


@dataclass(frozen=True)
class TitledTable:
    """A table with its title."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


def accuracy_table(report: Report, told: Report, metrics: Sequence[str] = TABLE_I) -> TitledTable:
    """Table I: these metrics of every method, with the paper's accuracy."""
    rows = [
        (
            method_label(record),
            *(with_interval(told["methods"][record["name"]][metric]) for metric in metrics),
            percent(paper_accuracy(record, report["paper"])),
        )
        for record in report["methods"]
    ]
    heads = ("method", *(f"{METRIC_WORDS[metric]} (%)" for metric in metrics), "accuracy in the paper (%)")
    return TitledTable(f"Table I: {candidates_line(told)}", heads, rows)


def choice_table(report: Report, told: Report) -> TitledTable:
    """How each method chooses among a robot's candidates of a set, and orders them."""
    rows = [
        (record["name"], *(with_interval(told["methods"][record["name"]][metric]) for metric in CHOICE))
        for record in report["methods"]
    ]
    title = f"choosing among a robot's candidates ({told['candidates']})"
    return TitledTable(title, ("method", *(f"{METRIC_WORDS[metric]} (%)" for metric in CHOICE)), rows)


def comparison_table(comparisons: Sequence[Report], where: str) -> TitledTable:
    """What regimes add to each other, and the best model to the best baseline, scene by scene."""
    rows = [
        (f"{d['first']} - {d['second']}", METRIC_WORDS[d["metric"]], with_interval(d, signed=True),
         d["verdict"] if d["verdict"] != "open" else "not told apart")
        for kind in ("regimes", "best")
        for d in comparisons
        if d["kind"] == kind and d["metric"] in _COMPARED
    ]  # fmt: skip
    title = f"differences over the same resampled scenes ({where}): regimes, and best model - best baseline"
    return TitledTable(title, ("difference", "by", "points", ""), rows)


def order_tables(
    records: Sequence[Report], differences: Sequence[Report], metrics: Sequence[str], where: str
) -> Iterator[TitledTable]:
    """Whom each of these methods is above and below, by metric; none where nobody else is there."""
    for metric in metrics:
        rows = [
            (record["name"], *("; ".join(names) or "-" for names in said.values()))
            for record in records
            if any((said := compared(differences, metric, record["name"])).values())
        ]
        if rows:
            title = f"by {METRIC_WORDS[metric]} ({where}): + where the two intervals are disjoint as well"
            yield TitledTable(title, ("method", "above", "not told apart from", "below"), rows)


def reach_table(report: Report, told: Report) -> TitledTable | None:
    """Table II: accuracy within and beyond reach; None where nothing is beyond."""
    inside, outside = told["in_reach"], told["out_of_reach"]
    if not outside["count"]:
        return None
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
    return TitledTable(
        title, ("method", "within reach (%)", "beyond (%)", "paper, all (%)", "paper, beyond (%)"), rows
    )


def grids_table(report: Report, grids: Report) -> TitledTable:
    """Table III: what the best-scored clear candidate of a grid is, and the order of all of them."""
    rows = [
        (
            record["name"],
            with_interval((told := grids["methods"][record["name"]])["good"]),
            metres_with_interval(told["missed_m"]),
            with_interval(told["mean_average_precision"]),
            f"{record['seconds_per_600']:.2g}",
        )
        for record in models_first(report["methods"])
    ]
    paper, chance = report["paper"], percent(grids["any_clear"])
    rows.append(("any clear candidate", chance, "-", chance, "-"))
    rows.append(
        ("paper, two-stage", percent(paper["grid_selection"]), f"{paper['grid_miss_m']:.2f}", "-",
         f"{paper['seconds_per_600']:g}")
    )  # fmt: skip
    heads = ("method", "best clear one good (%)", "else missed by (m)",
             f"{METRIC_WORDS['mean_average_precision']} (%)", "time per 600 (s)")  # fmt: skip
    return TitledTable(f"Table III: {grids_line(grids)}", heads, rows)


def calibration_table(report: Report, told: Report) -> TitledTable:
    """How far said probabilities can be believed; without rows where no method says any."""
    rows = [
        (record["name"], f"{said['brier']:.4f}", f"{said['expected_calibration_error']:.4f}")
        for record in report["methods"]
        if (said := told["methods"][record["name"]])["brier"] is not None
    ]
    heads = ("method", "Brier score", "expected calibration error")
    return TitledTable(f"probabilities ({told['candidates']})", heads, rows)


def breakdown_tables(report: Report, told: Report, most_methods: int | None = None) -> Iterator[TitledTable]:
    """Accuracy by kinds of candidates, of so many methods."""
    names = [record["name"] for record in models_first(report["methods"])][:most_methods]
    for heading in dict.fromkeys(row["by"] for row in told["breakdown"]):
        rows = [
            (
                row["group"],
                f"{row['count']:,}",
                percent(row["positives"] / row["count"]),
                *(percent(row["methods"][name]["accuracy"]) for name in names),
            )
            for row in told["breakdown"]
            if row["by"] == heading
        ]
        title = f"accuracy by {heading} ({told['candidates']}), in %"
        yield TitledTable(title, (heading, "count", "good (%)", *names), rows)


def notes(report: Report) -> list[tuple[str, str]]:
    """What has to be said beside the numbers: (of what, what)."""
    boot = report["bootstrap"]
    found = [
        (
            "intervals",
            f"{100 * boot['level']:g}% by {boot['resamples']:,} resamples of scenes, seed {boot['seed']}",
        ),
        ("clearance", "every method is told where the base fits, and says bad where it does not"),
        ("paper", f"{report['paper']['source']}: other houses, arms and candidates"),
    ]
    if any(record["threshold"] is None for record in report["methods"]):
        found.append(("*", "has no threshold: its pick of a robot's candidates is good, all others are bad"))
    found += [(record["name"], record["note"]) for record in report["methods"] if record["note"]]
    return found + [(name, f"left out: {why}") for name, why in report["left_out"].items()]


def part_title(report: Report, part: Report) -> str | None:
    """Whose houses the scenes of a part lie in; None where that goes without saying."""
    if len(report["parts"]) == 1 and part["houses"] != "seen":
        return None
    trained = "that were trained on" if part["houses"] == "seen" else "that nobody was trained on"
    return f"{part['scenes']:,} scenes in houses {trained}"
