"""An evaluation as tables on a terminal."""

from __future__ import annotations

from datagen.console.printing import print_rows
from datagen.evaluation_report import report_tables as tables
from datagen.evaluation_report.number_format import Report
from datagen.evaluation_report.report_tables import TitledTable

_MOST_COLUMNS = 5  # of methods in a breakdown


def print_evaluation(report: Report) -> None:
    """Tables I to III with the paper's numbers, differences, calibration and breakdowns."""
    models = [r for r in report["methods"] if r["regime"]] or report["methods"]
    for part in report["parts"]:
        if title := tables.part_title(report, part):
            print_rows(title, [])
        for name, told in part["sets"].items():
            _print(tables.accuracy_table(report, told, tables.DECISIONS))
            _print(tables.comparison_table(told["comparisons"], name))
            for shown in tables.order_tables(models, told["differences"], tables.DECISIONS[:2], name):
                _print(shown)
        for name, why in part["left_out"].items():
            print_rows(f"Table I: {name} is omitted", [("", why)])
        for told in part["sets"].values():
            _print(tables.reach_table(report, told))
        if (grids := part["grids"]) is None:
            print_rows("Table III: omitted", [("", part["no_grids"])])
        else:
            _print(tables.grids_table(report, grids))
            _print(tables.comparison_table(grids["comparisons"], "whole grids"))
            for shown in tables.order_tables(models, grids["differences"], tables.TABLE_III, "whole grids"):
                _print(shown)
        for told in part["sets"].values():
            _print(tables.calibration_table(report, told))
        # Methods differ most on the narrowest set.
        for told in list(part["sets"].values())[:1]:
            _print(tables.choice_table(report, told))
            for shown in tables.breakdown_tables(report, told, _MOST_COLUMNS):
                _print(shown)
    print_rows("notes", tables.notes(report))


def _print(shown: TitledTable | None) -> None:
    if shown is not None and shown.rows:
        print_rows(shown.title, shown.rows, shown.heads)
