"""An evaluation in a terminal: all its tables, or one short table of each part."""

from __future__ import annotations

from collections.abc import Mapping
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


def print_summary(report: Report) -> None:
    """Print one table of each part and, of a closed loop, its success."""
    for part in report["parts"]:
        for scores in list(part["sets"].values())[:1]:
            _print(_decisions(report, part, scores))
        if not part["sets"] and part["grids"] is not None:
            _print(_choices(report, part))
    if "closed_loop" in report:
        _print(next(loop_tables(report)))


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


def _choices(report: Report, part: Report) -> Table:
    methods = part["grids"]["methods"]
    shown = _best(report, methods, "good")
    rows = [(record["name"], with_interval(methods[record["name"]]["good"])) for record in shown]
    title = f"{part['title']}, whole grids: {part['grids']['scenes']:,} scenes{_left(report, shown)}"
    return Table(title, ("method", "choice positive (%)"), rows)


def _best(report: Report, methods: Mapping[str, Any], metric: str) -> list[Report]:
    """Records of all models and of the baselines with the highest values, the best first."""
    records = models_first(report["methods"])

    def value(record: Report) -> float:
        found = methods[record["name"]][metric]["value"]
        return -1.0 if found is None else float(found)

    models = [record for record in records if record["regime"] is not None]
    baselines = sorted((r for r in records if r["regime"] is None), key=value, reverse=True)
    return models + baselines[:_BASELINES]


def _left(report: Report, shown: list[Report]) -> str:
    left = len(report["methods"]) - len(shown)
    return f"; {left} weaker baselines: --full" if left else ""
