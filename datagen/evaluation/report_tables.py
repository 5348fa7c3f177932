"""The tables of an evaluation, and their numbers as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from datagen.evaluation.grids import AT_RANDOM, BY_LABELS, PICKS
from datagen.schemas.specification import DECISIVE_SHARES

Report = Mapping[str, Any]
DECISIONS = ("accuracy", "balanced_accuracy", "area_under_roc")
CHOICE = ("best_pick", "mean_average_precision")
METRIC_WORDS = {
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
    "area_under_roc": "AUC",
    "best_pick": "best choice positive",
    "good": "positive choices",
    "mean_average_precision": "mAP",
    "smoothed": "success",
}
SET_WORDS = {
    "in-range": "clear and within reach",
    "clear": "clear",
    "grid": "all cells; methods know where the base collides",
}
_DECISIVE = "{:.0%} to {:.0%} of the clear cells in reach are good".format(*DECISIVE_SHARES)
_TRIALS = {
    "plan": "arrives off its pick and plans from there",
    "sim": "arrives off its pick, plans from there and executes in a disturbed world",
}
_FAILURES_AT_M = 0.1


@dataclass(frozen=True)
class Table:
    """A table with its title."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


def set_tables(report: Report, scores: Report) -> Iterator[Table]:
    """The tables of one candidate set: methods, differences, reach and choices."""
    yield _accuracy(report, scores)
    yield _comparisons(scores["comparisons"], scores["candidates"])
    if scores["out_of_reach"]["count"]:
        yield _reach(report, scores)
    yield _choice(report, scores)


def _accuracy(report: Report, scores: Report) -> Table:
    """Table I: decisions and calibration of every method, the paper's accuracy, and the base rate."""
    share = scores["positives"] / scores["count"]
    of_methods = [
        (label_of(r), scores["methods"][r["name"]], paper_accuracy(r, report)) for r in report["methods"]
    ]
    of_means = [(mean["name"], mean, None) for mean in scores["means"]]
    rows = [
        (
            name,
            *(with_interval(values[metric]) for metric in DECISIONS),
            percent(values.get("expected_calibration_error")),
            percent(paper),
        )
        for name, values, paper in (*of_methods, *of_means)
    ]
    rows.append(("the commoner label", percent(max(share, 1 - share)), "50.0", "50.0", "-", "-"))
    words = f"{scores['count']:,} candidates of {scores['scenes']:,} scenes, {percent(share)}% positive"
    heads = ("method", *(METRIC_WORDS[metric] for metric in DECISIONS), "calibration error", "paper")
    return Table(f"Table I, in %: {SET_WORDS[scores['candidates']]}; {words}", heads, rows)


def _comparisons(comparisons: Sequence[Report], where: str) -> Table:
    rows = [
        (
            f"{d['first']} - {d['second']}",
            METRIC_WORDS[d["metric"]],
            with_interval(d, signed=True),
            d["verdict"] if d["verdict"] != "open" else "not significant",
        )
        for d in comparisons
        if d["kind"] != "other"
    ]
    title = f"paired differences: regimes, and best model - best baseline ({where})"
    return Table(title, ("difference", "by", "points", "verdict"), rows)


def _reach(report: Report, scores: Report) -> Table:
    """Table II: accuracy within and beyond reach."""
    rows = [
        (
            label_of(record),
            with_interval(scores["methods"][record["name"]]["accuracy_in_reach"]),
            with_interval(scores["methods"][record["name"]]["accuracy_out_of_reach"]),
            percent(paper_accuracy(record, report)) if record["regime"] else "-",
            percent(report["paper"]["accuracy_out_of_reach"])
            if record["regime"] == "two-stage" and _is_of_paper(record)
            else "-",
        )
        for record in models_first(report["methods"])
    ]
    inside, outside = scores["in_reach"]["count"], scores["out_of_reach"]["count"]
    title = f"Table II: {scores['candidates']}, {inside:,} within reach and {outside:,} beyond"
    return Table(
        title, ("method", "within reach (%)", "beyond (%)", "paper, all (%)", "paper, beyond (%)"), rows
    )


def _choice(report: Report, scores: Report) -> Table:
    rows = [
        (record["name"], *(with_interval(scores["methods"][record["name"]][metric]) for metric in CHOICE))
        for record in report["methods"]
    ]
    heads = ("method", *(f"{METRIC_WORDS[metric]} (%)" for metric in CHOICE))
    return Table(f"choosing among a robot's candidates ({scores['candidates']})", heads, rows)


def grid_tables(report: Report, grids: Report) -> Iterator[Table]:
    """Table III, picks and the order of a grid's cells, with their comparisons and success on arrival."""
    methods = [(r["name"], grids["methods"][r["name"]], f"{s:.2g}" if (s := r["seconds_per_600"]) else "-")
               for r in models_first(report["methods"])]  # fmt: skip
    rows = [
        (
            name,
            with_interval(values["good"]),
            _metres(values["missed_m"]),
            with_interval(values["mean_average_precision"]),
            percent(values["feasibility"]["value"]) if "feasibility" in values else "-",
            time_s,
        )
        for name, values, time_s in (*methods, *((mean["name"], mean, "-") for mean in grids["means"]))
    ]
    paper, chance = report["paper"], percent(grids["any_clear"])
    paper_values = (percent(paper["grid_selection"]), f"{paper['grid_miss_m']:.2f}", "-", "-")
    rows.append(("any clear candidate", chance, "-", chance, "50.0", "-"))
    rows.append(("paper, two-stage", *paper_values, f"{paper['seconds_per_600']:g}"))
    without = grids["scenes_without_positive"]
    title = (
        f"Table III: {grids['scenes'] - without:,} whole grids with a positive candidate, {without:,} without"
    )
    heads = ("choice positive (%)", "else missed by (m)", "mAP (%)", "feasible AUC", "600 in (s)")
    yield Table(title, ("method", *heads), rows)
    yield _comparisons(grids["comparisons"], "whole grids")
    if grids["arrivals"]:
        yield _arrivals(report, grids["arrivals"])


def _arrivals(report: Report, found: Sequence[Report]) -> Table:
    rows = [
        (
            record["name"] if pick == "nominal" else "",
            pick,
            *(percent(row["methods"][record["name"]][pick]["value"]) for row in found),
        )
        for record in models_first(report["methods"])
        for pick in PICKS
    ]
    rows += [(f"{key} clear candidate", "", *(percent(row[key]) for row in found)) for key in ("best", "any")]
    title = "success (%) where the robot parks off the pick, in any direction; smoothed by that error"
    return Table(title, ("method", "pick", *(row["arrival"] for row in found)), rows)


def loop_tables(report: Report) -> Iterator[Table]:
    """The tables of the closed loop: success, gain of smoothing, best methods, and causes."""
    loop = report["closed_loop"]
    names = [method["name"] for method in models_first(report["methods"])] + [BY_LABELS, AT_RANDOM]
    for part in loop["parts"]:
        rows = [
            (name if k == 0 else "", pick if len(picks) == len(PICKS) else "",
             *(with_interval(row["methods"][name][pick], digits=0) for row in part["table"]))
            for name in names
            for picks in [part["table"][0]["methods"][name]]
            for k, pick in enumerate(picks)
        ]  # fmt: skip
        title = f"success (%) in {part['scenes']} scenes: the robot {_TRIALS[loop['mode']]}"
        if part["scenes_of"] == "decisive":
            title = f"the same in {part['scenes']} decisive scenes: {_DECISIVE}"
        errors = [row["arrival"].removesuffix(" off") for row in part["table"]]
        yield Table(title, ("method", "pick", *errors), rows)
    whole = loop["parts"][0]["table"]
    errors = [row["arrival"].removesuffix(" off") for row in whole]
    gains = [
        (name, *(with_interval(row["gains"][name], signed=True, digits=0) for row in whole))
        for name in whole[0]["gains"]
    ]
    yield Table("points that smoothing gains", ("method", *errors), gains)
    best = [
        (row["arrival"], f"{d['first']} - {d['second']}", with_interval(d, signed=True), d["verdict"])
        for row in whole
        for d in row["comparisons"]
        if d["kind"] == "best"
    ]
    heads = ("arrival", "difference", "points", "verdict")
    yield Table("best model - best baseline, smoothed picks", heads, best)
    row = min(whole, key=lambda row: abs(row["distance_m"] - _FAILURES_AT_M))
    causes = [
        (name, pick, ", ".join(f"{cause} {percent(share)}" for cause, share in result["failures"].items()))
        for name in names
        for pick, result in row["methods"][name].items()
    ]
    yield Table(f"failures (% of arrivals, {row['arrival']})", ("method", "pick", "cause"), causes)


def notes(report: Report) -> list[tuple[str, str]]:
    """Return the notes on the numbers: (subject, note)."""
    boot = report["bootstrap"]
    method = f"{100 * boot['level']:g}% by {boot['resamples']:,} resamples of scenes, seed {boot['seed']}"
    found = [
        *_benchmark_notes(report.get("benchmark")),
        ("intervals", method),
        ("clearance", "every method knows where the base is clear, and predicts negative elsewhere"),
        (
            "paper",
            f"{report['paper']['source']}: other houses, arms and candidates; of the same method alone",
        ),
    ]
    if any(table["means"] for part in report["parts"] for table in (*part["sets"].values(),)):
        found.append(
            ("means", "over trainings that differ by their seed alone; their intervals hold seeds too")
        )
    if any(record["threshold"] is None for record in report["methods"]):
        found.append(("*", "has no threshold: its choice for each robot is positive, the rest negative"))
    found += [
        (run["place"], f"{part['label_source']} labels, split {part['split']}, {part['per_scene']} "
         f"{part['candidates']} candidates a scene, specification {part['spec_hash'][:12]}")
        for run in report["runs"] for part in run["parts"]
    ]  # fmt: skip
    if report["fitted_on"]:
        found.append(("baselines", f"fitted on {', '.join(report['fitted_on'])}"))
    if loop := report.get("closed_loop"):
        count = loop["arrivals"]
        found += [
            ("arrivals", f"{loop['arrivals_per_scene']} a scene and error, the same for all methods; "
                         f"{count['wanted']:,} in all, {count['distinct']:,} of them distinct"),
            ("closed loop", f"leaves out {loop['scenes_without_good']} grids without a good clear cell"),
        ]  # fmt: skip
    for record in report["methods"]:
        if (head := record["checkpoint"]) is not None:
            told = f"{head['model']} ({record['regime']}), weights {head['weights_sha256'][:12]}"
            found.append((record["name"], f"{head['file']}: {told}"))
        elif record["note"]:
            found.append((record["name"], record["note"]))
    return found + [(name, f"omitted: {why}") for name, why in report["left_out"].items()]


def _benchmark_notes(benchmark: Report | None) -> Iterator[tuple[str, str]]:
    if benchmark is None:
        return
    yield "benchmark", f"version {benchmark['version']}, {benchmark['digest'][:12]}"
    for name, run in benchmark["runs"].items():
        digests = run["digests"]
        frozen = (
            f"candidates {digests['candidates'][:12]}, labels {digests['labels'][:12]}"
            if digests
            else "not frozen: its candidates and labels were not compared"
        )
        yield name, f"{run['about']}; {frozen}"
    yield "decisive", _DECISIVE
    if benchmark["not_scored"]:
        yield "not scored", f"{', '.join(benchmark['not_scored'])}: every row is incomplete"


def percent(value: float | None, signed: bool = False, digits: int = 1) -> str:
    """0.8413 as 84.1, or +84.1."""
    return "-" if value is None else f"{100 * value:{'+' if signed else ''}.{digits}f}"


def with_interval(estimate: Report, signed: bool = False, digits: int = 1) -> str:
    """Percent with its interval: 84.1 [82.0, 86.2]."""
    value, low, high = (percent(estimate[k], signed, digits) for k in ("value", "low", "high"))
    return value if estimate["value"] is None or estimate["low"] is None else f"{value} [{low}, {high}]"


def _metres(estimate: Report) -> str:
    """Metres with their interval: 0.24 [0.20, 0.31]."""
    if estimate["value"] is None:
        return "-"
    low, high = (f"{e:.2f}" if (e := estimate[k]) is not None else "-" for k in ("low", "high"))
    return f"{estimate['value']:.2f} [{low}, {high}]"


def label_of(record: Report) -> str:
    """A method's name, with * where it has no threshold."""
    return record["name"] + (" *" if record["threshold"] is None else "")


def paper_accuracy(record: Report, report: Report) -> float | None:
    """The paper's accuracy of the same baseline, or of its own network in the same regime; else None."""
    if record["regime"] and not _is_of_paper(record):
        return None
    return report["paper"]["accuracy"].get(record["regime"] or record["name"])


def _is_of_paper(record: Report) -> bool:
    return record["checkpoint"] is not None and record["checkpoint"]["model"] == "paper"


def models_first(records: Sequence[Report]) -> list[Report]:
    """Methods, models before baselines."""
    return sorted(records, key=lambda record: record["regime"] is None)
