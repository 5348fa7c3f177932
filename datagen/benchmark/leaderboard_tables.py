"""The leaderboard as tables, for terminal and page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from datagen.console.printing import print_rows
from datagen.display.html_page import escape, html_facts, html_page, html_table
from datagen.evaluation_report.report_tables import (
    MEANS_NOTE,
    METRIC_WORDS,
    TitledTable,
    metres_with_interval,
    percent,
    with_interval,
)
from datagen.train.evaluation.arrival_success import PICKS
from datagen.train.evaluation.grids import HARD_SHARE

Report = Mapping[str, Any]


def tables(report: Report) -> Iterator[TitledTable]:
    """All tables, decisions first."""
    for name, scores in report["candidates"].items():
        yield decisions_table(report, name, scores)
        yield from differences_table(name, scores)
    for name, scores in report["grids"].items():
        for which in ("mixed", "hard"):
            if scores[which] is not None:
                yield picks_table(report, name, which, scores[which])
                yield arrivals_table(report, name, which, scores[which])


def decisions_table(report: Report, name: str, scores: Report) -> TitledTable:
    """Balanced accuracy and AUC, calibration, and raw accuracy last, with its base rate."""
    rows = [
        (method, with_interval(values["balanced_accuracy"]), with_interval(values["area_under_roc"]),
         percent(values["expected_calibration_error"]), with_interval(values["accuracy"]))
        for method, values in scores["methods"].items()
    ]  # fmt: skip
    rows += [
        (mean["name"], with_interval(mean["balanced_accuracy"]), with_interval(mean["area_under_roc"]), "-",
         with_interval(mean["accuracy"]))
        for mean in scores["means"]
    ]  # fmt: skip
    rows.append(("the commoner label", "50.0", "50.0", "-", percent(scores["base_rate"])))
    heads = ("method", "balanced accuracy (%)", "AUC (%)", "calibration error (%)", "accuracy (%)")
    about, rate = report["benchmark"]["runs"][name]["about"], percent(scores["positive_rate"])
    counts = f"{scores['candidates']:,} candidates within reach of {scores['scenes']:,} scenes"
    title = f"{name}: {about}; {counts}, {rate}% good"
    return TitledTable(title, heads, rows)


def differences_table(name: str, scores: Report) -> Iterator[TitledTable]:
    """The best model minus the best baseline; nothing without both."""
    rows = [
        (f"{d['first']} - {d['second']}", METRIC_WORDS[d["metric"]], with_interval(d, signed=True))
        for d in scores["differences"]
    ]
    if rows:
        yield TitledTable(
            f"{name}: best model - best baseline, both chosen on these scenes",
            ("difference", "by", "points"),
            rows,
        )


def picks_table(report: Report, name: str, which: str, scores: Report) -> TitledTable:
    """How often the best-scored clear cell is good, and how far off it is otherwise."""
    rows = [
        (method, with_interval(values["good"]), metres_with_interval(values["missed_m"]),
         with_interval(values["mean_average_precision"]))
        for method, values in scores["methods"].items()
    ]  # fmt: skip
    rows += [
        (mean["name"], with_interval(mean["good"]), metres_with_interval(mean["missed_m"]),
         with_interval(mean["mean_average_precision"]))
        for mean in scores["means"]
    ]  # fmt: skip
    rows.append(("any clear cell", percent(scores["any_clear"]), "-", percent(scores["any_clear"])))
    heads = ("method", "best cell good (%)", "else missed by (m)", "mAP (%)")
    return TitledTable(_grids_title(report, name, which, scores), heads, rows)


def arrivals_table(report: Report, name: str, which: str, scores: Report) -> TitledTable:
    """Success of each method's pick when the robot parks with a position error."""
    found = scores["arrivals"]
    rows = [
        (method if pick == PICKS[0] else "", pick,
         *(percent(row["methods"][method][pick]["value"]) for row in found))
        for method in scores["methods"]
        for pick in PICKS
    ]  # fmt: skip
    rows += [
        (f"{words} clear cell", "", *(percent(row[key]) for row in found))
        for key, words in (("best", "best"), ("any", "any"))
    ]
    title = f"{name}, {which}: success (%) where the robot parks off the pick, in any direction"
    return TitledTable(title, ("method", "pick", *(row["arrival"] for row in found)), rows)


def _grids_title(report: Report, name: str, which: str, scores: Report) -> str:
    words = (
        "good and bad clear cells"
        if which == "mixed"
        else f"at most {HARD_SHARE:.0%} of the clear cells good"
    )
    about = report["benchmark"]["runs"][name]["about"]
    return f"{name}, {which}: {about}; {scores['scenes']:,} grids with {words}"


def facts(report: Report) -> list[tuple[str, str]]:
    """Facts about the leaderboard: benchmark, runs, intervals, and notes on the methods."""
    benchmark, boot = report["benchmark"], report["bootstrap"]
    found = [("benchmark", f"version {benchmark['version']}, {benchmark['digest'][:12]}")]
    for name, run in benchmark["runs"].items():
        digests = run["digests"]
        text = f"specification {run['spec_hash'][:12]}"
        if digests is None:
            text += "; not frozen: its candidates and labels were not compared"
        else:
            text += f", candidates {digests['candidates'][:12]}, labels {digests['labels'][:12]}"
        found.append((f"run {name}", text))
    if benchmark["not_scored"]:
        found.append(("not scored", f"{', '.join(benchmark['not_scored'])}: every row is incomplete"))
    found.append(
        ("intervals",
         f"{100 * boot['level']:g}% by {boot['resamples']:,} resamples of scenes, seed {boot['seed']}")
    )  # fmt: skip
    if any(scores["means"] for scores in report["candidates"].values()):
        found.append(MEANS_NOTE)
    found.append(("clearance", "every method knows where the base is clear, and predicts negative elsewhere"))
    if report["fitted_on"]:
        found.append(("baselines", f"fitted on {', '.join(report['fitted_on'])}"))
    for method in report["methods"]:
        if checkpoint := method.get("checkpoint"):
            text = f"{checkpoint['model']} ({method['regime']}), weights {checkpoint['weights_sha256'][:12]}"
            found.append((method["name"], text))
        elif method["note"]:
            found.append((method["name"], method["note"]))
        if method["threshold"] is None:
            found.append((method["name"], "has no threshold: each robot's choice counts as positive"))
    return found


def print_leaderboard(report: Report) -> None:
    """Print all tables, then the facts."""
    for shown in tables(report):
        print_rows(shown.title, shown.rows, shown.heads)
    print_rows("notes", facts(report))


def page_of(report: Report) -> str:
    """The leaderboard as one HTML page."""
    body: list[str] = [html_facts(facts(report))]
    for shown in tables(report):
        body += [f"<h2>{escape(shown.title)}</h2>", html_table(shown.heads, shown.rows)]
    body.append(f"<p class=note>datagen {escape(report['datagen'])}</p>")
    return html_page(f"Base placement benchmark {report['benchmark']['version']}", body)
