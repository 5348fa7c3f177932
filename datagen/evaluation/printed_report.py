"""An evaluation in a terminal: all its tables, or a summary of decisions and picks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from datagen.console.printing import print_rows
from datagen.evaluation.report_tables import (
    METRIC_WORDS,
    SET_WORDS,
    Report,
    Table,
    grid_tables,
    label_of,
    loop_tables,
    models_first,
    notes,
    paper_accuracy,
    percent,
    set_tables,
    with_interval,
)

_SHOWN = ("balanced_accuracy", "area_under_roc", "accuracy")
_BASELINES = 3
_ACROSS = 5  # methods beside each other, in 110 columns
_ERRORS = ("0.05 m off", "0.1 m off")


def print_summary(report: Report) -> None:
    """Print the picks on whole grids, decisions of each part and, of a closed loop, its success."""
    grids = [part for part in report["parts"] if not part["sets"] and part["grids"] is not None]
    if grids:
        _print(*_picks(report, grids))
    for part in report["parts"]:
        for scores in list(part["sets"].values())[:1]:
            _print(_decisions(report, part, scores))
    if "closed_loop" in report:
        _print(next(loop_tables(report)))
    if "benchmark" in report:
        print_rows("", [note for note in notes(report) if note[0] in ("benchmark", "not scored")])


def print_all(report: Report) -> None:
    """Print every table, and the notes on the numbers."""
    for part in report["parts"]:
        print_rows(f"{part['title']}: {part['scenes']:,} scenes", [])
        for scores in part["sets"].values():
            _print(*set_tables(report, scores))
        if part["grids"] is not None:
            _print(*grid_tables(report, part["grids"]))
        _print(Table("omitted", ("table", "reason"), list(part["left_out"].items())))
    if "closed_loop" in report:
        print_rows("Closed loop", [])
        _print(*loop_tables(report))
    print_rows("notes", notes(report))


def _print(*tables: Table) -> None:
    for table in tables:
        print_rows(table.title, table.rows, table.heads)


def _decisions(report: Report, part: Report, scores: Report) -> Table:
    shown = _best(report, scores["methods"], "balanced_accuracy")
    rows = [
        (
            label_of(record),
            *(with_interval(scores["methods"][record["name"]][metric]) for metric in _SHOWN),
            percent(paper_accuracy(record, report)),
        )
        for record in shown
    ]
    words = f"{scores['count']:,} candidates, {percent(scores['positives'] / scores['count'])}% positive"
    title = f"{part['title']}, {SET_WORDS[scores['candidates']]}: {words}; in %{_left(report, shown)}"
    return Table(title, ("method", *(METRIC_WORDS[m] for m in _SHOWN), "paper: accuracy"), rows)


def _picks(report: Report, parts: Sequence[Report]) -> Iterator[Table]:
    """Picks of every part with an interval, and those of decisive grids where the robot parks off them."""
    shown = _best(report, parts[0]["grids"]["methods"], "good")
    title = f"good picks (%) in whole grids with a good cell (their number){_left(report, shown)}"
    size = math.ceil(len(shown) / math.ceil(len(shown) / _ACROSS))
    for start in range(0, len(shown), size):
        names = [record["name"] for record in shown[start : start + size]]
        rows = []
        for part in parts:
            grids = part["grids"]
            feasible = grids["scenes"] - grids["scenes_without_positive"]
            good = (with_interval(grids["methods"][name]["good"], digits=0) for name in names)
            rows.append((f"{part['title']} ({feasible})", *good))
            for row in grids["arrivals"] if part["title"].endswith("decisive") else ():
                if row["arrival"] in _ERRORS:
                    values = (percent(row["methods"][n]["smoothed"]["value"], digits=0) for n in names)
                    rows.append((f"  {row['arrival']}", *values))
        yield Table(title, ("grids", *names), rows)


def _best(report: Report, methods: Mapping[str, Any], metric: str) -> list[Report]:
    """Records of all models and of the best baselines, in order; a benchmark's methods were all asked for."""
    records = models_first(report["methods"])

    def value(record: Report) -> float:
        found = methods[record["name"]][metric]["value"]
        return -1.0 if found is None else float(found)

    models = [record for record in records if record["regime"] is not None]
    baselines = sorted((r for r in records if r["regime"] is None), key=value, reverse=True)
    return models + baselines[: None if "benchmark" in report else _BASELINES]


def _left(report: Report, shown: list[Report]) -> str:
    left = len(report["methods"]) - len(shown)
    return f"; {left} weaker baselines: --full" if left else ""
