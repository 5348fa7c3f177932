"""The tables of an evaluation, for page and terminal, and their numbers as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from datagen.console.printing import print_rows

DECISIONS = ("accuracy", "balanced_accuracy", "area_under_roc")
CHOICE = ("best_pick", "mean_average_precision")
TABLE_I = (*DECISIONS, *CHOICE)
TABLE_III = ("good", "mean_average_precision")
# Metrics that compare regimes.
_COMPARED = ("accuracy", "balanced_accuracy", "good", "mean_average_precision")


Report = Mapping[str, Any]
METRIC_WORDS = {
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
    "area_under_roc": "AUC",
    "best_pick": "best choice positive",
    "good": "positive choices",
    "mean_average_precision": "mAP",
}
SET_WORDS = {
    "in-range": "clear and within reach",
    "clear": "clear",
    "grid": "all cells; methods know where the base collides",
}
_MOST_COLUMNS = 5  # of methods in a breakdown


@dataclass(frozen=True)
class TitledTable:
    """A table with its title."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


MEANS_NOTE = ("means", "over trainings that differ by their seed alone; their intervals hold seeds too")


def accuracy_table(report: Report, scores: Report, metrics: Sequence[str] = TABLE_I) -> TitledTable:
    """Return Table I: these metrics of every method, with the paper's accuracy."""
    rows = [
        (
            method_label(record),
            *(with_interval(scores["methods"][record["name"]][metric]) for metric in metrics),
            percent(paper_accuracy(record, report["paper"])),
        )
        for record in report["methods"]
    ]
    rows += [
        (mean["name"], *(with_interval(mean[metric]) for metric in metrics), "-")
        for mean in scores.get("means", ())  # files of earlier versions have none
    ]
    heads = ("method", *(f"{METRIC_WORDS[metric]} (%)" for metric in metrics), "accuracy in the paper (%)")
    return TitledTable(f"Table I: {candidates_line(scores)}", heads, rows)


def choice_table(report: Report, scores: Report) -> TitledTable:
    """Return the table of choices among a robot's candidates of a set, and of their order."""
    rows = [
        (record["name"], *(with_interval(scores["methods"][record["name"]][metric]) for metric in CHOICE))
        for record in report["methods"]
    ]
    title = f"choosing among a robot's candidates ({scores['candidates']})"
    return TitledTable(title, ("method", *(f"{METRIC_WORDS[metric]} (%)" for metric in CHOICE)), rows)


def comparison_table(comparisons: Sequence[Report], where: str) -> TitledTable:
    """Return the paired differences between regimes, and between the best model and the best baseline."""
    rows = [
        (f"{d['first']} - {d['second']}", METRIC_WORDS[d["metric"]], with_interval(d, signed=True),
         d["verdict"] if d["verdict"] != "open" else "not significant")
        for kind in ("regimes", "best")
        for d in comparisons
        if d["kind"] == kind and d["metric"] in _COMPARED
    ]  # fmt: skip
    title = f"paired differences ({where}): regimes, and best model - best baseline"
    return TitledTable(title, ("difference", "by", "points", ""), rows)


def order_tables(
    records: Sequence[Report], differences: Sequence[Report], metrics: Sequence[str], where: str
) -> Iterator[TitledTable]:
    """Return which methods each method is above and below, by metric; empty for one method."""
    for metric in metrics:
        rows = [
            (record["name"], *("; ".join(names) or "-" for names in others.values()))
            for record in records
            if any((others := compared(differences, metric, record["name"])).values())
        ]
        if rows:
            title = f"by {METRIC_WORDS[metric]} ({where}): + where the two intervals are disjoint as well"
            yield TitledTable(title, ("method", "above", "not significant", "below"), rows)


def reach_table(report: Report, scores: Report) -> TitledTable | None:
    """Return Table II: accuracy within and beyond reach; None where no candidate is beyond."""
    inside, outside = scores["in_reach"], scores["out_of_reach"]
    if not outside["count"]:
        return None
    rows = [
        (
            method_label(record),
            with_interval(scores["methods"][record["name"]]["accuracy_in_reach"]),
            with_interval(scores["methods"][record["name"]]["accuracy_out_of_reach"]),
            percent(paper_accuracy(record, report["paper"])) if record["regime"] else "-",
            percent(report["paper"]["accuracy_out_of_reach"]) if record["regime"] == "two-stage" else "-",
        )
        for record in models_first(report["methods"])
    ]
    title = (
        f"Table II: {scores['candidates']}, {inside['count']:,} within reach and {outside['count']:,} beyond"
    )
    return TitledTable(
        title, ("method", "within reach (%)", "beyond (%)", "paper, all (%)", "paper, beyond (%)"), rows
    )


def grids_table(report: Report, grids: Report) -> TitledTable:
    """Return Table III: label of the best-scored clear candidate of a grid, and the order of all."""
    rows = [
        (
            record["name"],
            with_interval((scores := grids["methods"][record["name"]])["good"]),
            metres_with_interval(scores["missed_m"]),
            with_interval(scores["mean_average_precision"]),
            f"{record['seconds_per_600']:.2g}",
        )
        for record in models_first(report["methods"])
    ]
    rows += [
        (mean["name"], with_interval(mean["good"]), metres_with_interval(mean["missed_m"]),
         with_interval(mean["mean_average_precision"]), "-")
        for mean in grids.get("means", ())
    ]  # fmt: skip
    paper, chance = report["paper"], percent(grids["any_clear"])
    rows.append(("any clear candidate", chance, "-", chance, "-"))
    rows.append(
        ("paper, two-stage", percent(paper["grid_selection"]), f"{paper['grid_miss_m']:.2f}", "-",
         f"{paper['seconds_per_600']:g}")
    )  # fmt: skip
    heads = ("method", "choice positive (%)", "else missed by (m)",
             f"{METRIC_WORDS['mean_average_precision']} (%)", "time per 600 (s)")  # fmt: skip
    return TitledTable(f"Table III: {grids_line(grids)}", heads, rows)


def arrival_table(report: Report, grids: Report) -> TitledTable | None:
    """Return the success of picks when the robot parks with an error; None without whole square grids."""
    if not (found := grids["arrivals"]):
        return None

    def success(name: str, pick: str) -> list[str]:
        return [percent(row["methods"][name][pick]["value"]) for row in found]

    rows = [
        (record["name"] if pick == "nominal" else "", pick, *success(record["name"], pick))
        for record in models_first(report["methods"])
        for pick in ("nominal", "smoothed")
    ]
    rows.append(("best clear candidate", "", *(percent(row["best"]) for row in found)))
    rows.append(("any clear candidate", "", *(percent(row["any"]) for row in found)))
    title = "success (%) where the robot parks off the pick, in any direction; smoothed by that error"
    return TitledTable(title, ("method", "pick", *(row["arrival"] for row in found)), rows)


def calibration_table(report: Report, scores: Report) -> TitledTable:
    """Return the table of calibration errors; without rows where no method predicts probabilities."""
    rows = [
        (record["name"], f"{values['brier']:.4f}", f"{values['expected_calibration_error']:.4f}")
        for record in report["methods"]
        if (values := scores["methods"][record["name"]])["brier"] is not None
    ]
    heads = ("method", "Brier score", "calibration error (ECE)")
    return TitledTable(f"probabilities ({scores['candidates']})", heads, rows)


def breakdown_tables(
    report: Report, scores: Report, most_methods: int | None = None
) -> Iterator[TitledTable]:
    """Return tables of accuracy by groups of candidates, for at most `most_methods` methods."""
    names = [record["name"] for record in models_first(report["methods"])][:most_methods]
    for heading in dict.fromkeys(row["by"] for row in scores["breakdown"]):
        rows = [
            (
                row["group"],
                f"{row['count']:,}",
                percent(row["positives"] / row["count"]),
                *(percent(row["methods"][name]["accuracy"]) for name in names),
            )
            for row in scores["breakdown"]
            if row["by"] == heading
        ]
        title = f"accuracy by {heading} ({scores['candidates']}), in %"
        yield TitledTable(title, (heading, "count", "good (%)", *names), rows)


def notes(report: Report) -> list[tuple[str, str]]:
    """Return the notes on the numbers: (subject, note)."""
    boot = report["bootstrap"]
    found = [
        (
            "intervals",
            f"{100 * boot['level']:g}% by {boot['resamples']:,} resamples of scenes, seed {boot['seed']}",
        ),
        ("clearance", "every method knows where the base is clear, and predicts negative elsewhere"),
        ("paper", f"{report['paper']['source']}: other houses, arms and candidates"),
    ]
    if any(scores.get("means") for part in report["parts"] for scores in part["sets"].values()):
        found.append(MEANS_NOTE)
    if any(record["threshold"] is None for record in report["methods"]):
        found.append(("*", "has no threshold: its choice for each robot is positive, the rest negative"))
    found += [(record["name"], record["note"]) for record in report["methods"] if record["note"]]
    return found + [(name, f"omitted: {why}") for name, why in report["left_out"].items()]


def part_title(report: Report, part: Report) -> str | None:
    """Heading of a part by its houses; None where there is one part."""
    if len(report["parts"]) == 1 and part["houses"] != "seen":
        return None
    kind = "training" if part["houses"] == "seen" else "other"
    return f"{part['scenes']:,} scenes in {kind} houses"


def percent(value: float | None, signed: bool = False) -> str:
    """0.8413 as 84.1, or +84.1."""
    return "-" if value is None else f"{100 * value:{'+' if signed else ''}.1f}"


def with_interval(estimate: Report, signed: bool = False) -> str:
    """Percent with its interval: 84.1 [82.0, 86.2]."""
    if estimate["value"] is None:
        return "-"
    value, low, high = (percent(estimate[k], signed) for k in ("value", "low", "high"))
    return value if estimate["low"] is None else f"{value} [{low}, {high}]"


def metres_with_interval(estimate: Report) -> str:
    """Metres with their interval: 0.24 [0.20, 0.31]."""
    if estimate["value"] is None:
        return "-"
    low, high = (f"{e:.2f}" if (e := estimate[k]) is not None else "-" for k in ("low", "high"))
    return f"{estimate['value']:.2f} [{low}, {high}]"


def method_label(record: Report) -> str:
    """A method's name, with * where it has no threshold."""
    return record["name"] + (" *" if record["threshold"] is None else "")


def paper_accuracy(record: Report, paper: Report) -> float | None:
    """The paper's number for the same method or regime, if there is one."""
    return paper["accuracy"].get(record["regime"] or record["name"])


def models_first(records: Sequence[Report]) -> list[Report]:
    """Methods, models before baselines."""
    return sorted(records, key=lambda record: record["regime"] is None)


def compared(differences: Sequence[Report], metric: str, name: str) -> dict[str, list[str]]:
    """Other methods by the verdict on a metric: `above`, `open`, `below`; + where intervals are disjoint."""
    found: dict[str, list[str]] = {"above": [], "open": [], "below": []}
    other_way = {"above": "below", "below": "above", "open": "open"}
    for d in differences:
        if d["metric"] != metric or name not in (d["first"], d["second"]):
            continue
        is_first = d["first"] == name
        verdict = d["verdict"] if is_first else other_way[d["verdict"]]
        found[verdict].append((d["second"] if is_first else d["first"]) + ("+" if d["disjoint"] else ""))
    return found


def candidates_line(scores: Report) -> str:
    """Size of a set: 1,200 candidates of 80 scenes (clear), 31.0% positive."""
    share = percent(scores["positives"] / scores["count"])
    words = SET_WORDS[scores["candidates"]]
    return f"{scores['count']:,} candidates of {scores['scenes']:,} scenes ({words}), {share}% positive"


def grids_line(grids: Report) -> str:
    """Number of whole grids, and the result of a random choice."""
    counted = grids["scenes"] - grids["scenes_without_positive"]
    return (
        f"{counted:,} whole grids with a positive candidate, {grids['scenes_without_positive']:,} without; "
        f"{percent(grids['any_clear'])}% of their clear candidates are positive"
    )


def print_evaluation(report: Report) -> None:
    """Print Tables I to III with the paper's numbers, differences, calibration and breakdowns."""
    models = [r for r in report["methods"] if r["regime"]] or report["methods"]
    for part in report["parts"]:
        if title := part_title(report, part):
            print_rows(title, [])
        for name, scores in part["sets"].items():
            _print(accuracy_table(report, scores, DECISIONS))
            _print(comparison_table(scores["comparisons"], name))
            for shown in order_tables(models, scores["differences"], DECISIONS[:2], name):
                _print(shown)
        for name, why in part["left_out"].items():
            print_rows(f"Table I: {name} is omitted", [("", why)])
        for scores in part["sets"].values():
            _print(reach_table(report, scores))
        if (grids := part["grids"]) is None:
            print_rows("Table III: omitted", [("", part["no_grids"])])
        else:
            _print(arrival_table(report, grids))
            _print(grids_table(report, grids))
            _print(comparison_table(grids["comparisons"], "whole grids"))
            for shown in order_tables(models, grids["differences"], TABLE_III, "whole grids"):
                _print(shown)
        for scores in part["sets"].values():
            _print(calibration_table(report, scores))
        # Methods differ most on the narrowest set.
        for scores in list(part["sets"].values())[:1]:
            _print(choice_table(report, scores))
            for shown in breakdown_tables(report, scores, _MOST_COLUMNS):
                _print(shown)
    print_rows("notes", notes(report))


def _print(shown: TitledTable | None) -> None:
    if shown is not None:
        print_rows(shown.title, shown.rows, shown.heads)
