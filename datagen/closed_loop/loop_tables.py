"""The tables of a closed loop for the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from datagen.console.printing import counted, print_rows
from datagen.evaluation_report.report_tables import TitledTable, models_first, percent, with_interval
from datagen.train.evaluation.arrival_success import PICKS
from datagen.train.evaluation.closed_loop import AT_RANDOM, BY_LABELS

Record = Mapping[str, Any]
_DONE = {"plan": "plans from there", "sim": "plans from there and executes in a disturbed world"}
_FAILURES_AT_M = 0.1


def print_loop(record: Record, files: Sequence[tuple[str, str]]) -> None:
    """Success by arrival error, gains, failures by cause, agreement with the labels, notes and files."""
    for table in tables_of(record):
        print_rows(table.title, table.rows, table.heads)
    print_rows("notes", _notes(record))
    print_rows("written", list(files))


def tables_of(record: Record) -> Iterator[TitledTable]:
    """The tables, most important first."""
    for part in record["parts"]:
        yield _success(record, part)
    whole = record["parts"][0]
    yield from _differences(record, whole)
    yield _failures(record, whole)
    yield _agreement(record)


def shown_methods(record: Record) -> list[str]:
    """Methods, models first, then the choices that no method makes."""
    return [method["name"] for method in models_first(record["methods"])] + [BY_LABELS, AT_RANDOM]


def _success(record: Record, part: Record) -> TitledTable:
    rows = [
        (
            name if k == 0 else "",
            pick if len(PICKS) == len(first) else "",
            *(_whole(row["methods"][name][pick]) for row in part["table"]),
        )
        for name in shown_methods(record)
        for first in [part["table"][0]["methods"][name]]
        for k, pick in enumerate(first)
    ]
    of = counted(part["scenes"], "scene")
    title = f"success (%) in {of}: the robot arrives off its pick and {_DONE[record['mode']]}"
    if part["scenes_of"] == "hard":
        title = f"the same in {of} with at most {100 * record['hard_share']:.0f}% of the clear cells good"
    return TitledTable(title, ("method", "pick", *_errors(part)), rows)


def _differences(record: Record, part: Record) -> Iterator[TitledTable]:
    rows = [
        (name, *(_whole(row["gains"][name], signed=True) for row in part["table"]))
        for name in shown_methods(record)
        if name in part["table"][0]["gains"]
    ]
    yield TitledTable("points that smoothing gains", ("method", *_errors(part)), rows)
    best = [
        (row["arrival"], f"{d['first']} - {d['second']}", with_interval(d, signed=True), d["verdict"])
        for row in part["table"]
        for d in row["comparisons"]
        if d["kind"] == "best"
    ]
    heads = ("arrival", "difference", "points", "")
    yield TitledTable("best model - best baseline, smoothed picks", heads, best)


def _failures(record: Record, part: Record) -> TitledTable:
    row = min(part["table"], key=lambda row: abs(row["distance_m"] - _FAILURES_AT_M))
    rows = [
        (
            name,
            pick,
            ", ".join(f"{cause} {percent(share)}" for cause, share in result["failures"].items()) or "none",
        )
        for name in shown_methods(record)
        for pick, result in row["methods"][name].items()
    ]
    return TitledTable(f"failures (% of arrivals, {row['arrival']})", ("method", "pick", "cause"), rows)


def _agreement(record: Record) -> TitledTable:
    rows = [
        (
            row["arrival"],
            f"{row['distinct']:,}",
            *(
                percent(row[key])
                for key in ("success", "nearest_label", "bilinear_label", "agree_with_nearest")
            ),
        )
        for row in record["agreement"]
    ]
    heads = ("arrival", "distinct arrivals", "success (%)", "by nearest label (%)", "between labels (%)",
             "agree with nearest (%)")  # fmt: skip
    return TitledTable("agreement with the labels around each arrival", heads, rows)


def _errors(part: Record) -> list[str]:
    return [row["arrival"].removesuffix(" off") for row in part["table"]]


def _notes(record: Record) -> list[tuple[str, str]]:
    boot, count = record["bootstrap"], record["arrivals"]
    found = [
        (
            "intervals",
            f"{100 * boot['level']:g}% by {boot['resamples']:,} resamples of scenes, seed {boot['seed']}",
        ),
        ("arrivals", f"{record['arrivals_per_scene']} a scene and error, the same for all methods; "
                     f"{count['wanted']:,} in all, {count['distinct']:,} of them distinct"),
        ("left out", f"{counted(record['scenes_without_good'], 'scene')} without a good clear cell"),
        ("clearance", "every method knows where the base is clear; arriving where it is not is a failure"),
    ]  # fmt: skip
    found += [(method["name"], method["note"]) for method in record["methods"] if method["note"]]
    return found + [(name, f"omitted: {why}") for name, why in record["left_out"].items()]


def _whole(estimate: Record, signed: bool = False) -> str:
    """Whole percents with their interval: 84 [80, 88]."""
    form = "{:+.0f}" if signed else "{:.0f}"
    shown = ["-" if estimate[k] is None else form.format(100 * estimate[k]) for k in ("value", "low", "high")]
    return f"{shown[0]} [{shown[1]}, {shown[2]}]"
