"""An evaluation as one HTML page that needs nothing beside it: tables, curves, and grids of a few scenes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from datagen.evaluation_report import report_tables as tables
from datagen.evaluation_report.figures import (
    GRIDS_CAPTION,
    draw_curves,
    draw_examples,
    draw_intervals,
    svg_of,
)
from datagen.evaluation_report.report_tables import Report, TitledTable
from datagen.train.evaluation.columns import Gathered
from datagen.train.html_page import escape, html_facts, html_figure, html_page, html_table


def page_of(report: Report, gathered: Gathered) -> str:
    """The whole page."""
    body = [_about(report)]
    for number, part in enumerate(report["parts"]):
        if title := tables.part_title(report, part):
            body.append(f"<h2>{escape(title)}</h2>")
        for name, told in part["sets"].items():
            body += _set(report, told, f"{number}-{name}")
        for name, why in part["left_out"].items():
            body.append(f"<h2>Table I: {escape(name)} left out</h2><p>{escape(why)}</p>")
        body += _grids(report, part)
    if gathered.examples:
        figure = draw_examples(gathered.examples, gathered.columns, report["methods"])
        body += ["<h2>Example grids</h2>", html_figure(svg_of(figure, "examples"), GRIDS_CAPTION)]
    body += [*_sources(report)]
    return html_page("Evaluation of base placement", body)


def _about(report: Report) -> str:
    places = ", ".join(run["place"] for run in report["runs"])
    return html_facts([("labels", places), *tables.notes(report)])


def _set(report: Report, told: Report, name: str) -> list[str]:
    candidates = told["candidates"]
    return [
        *_shown(
            tables.accuracy_table(report, told),
            "h2",
            html_figure(svg_of(draw_intervals(report, told), f"intervals-{name}")),
        ),
        *_shown(tables.comparison_table(told["comparisons"], candidates), kind="text"),
        *_order(report, told["differences"], tables.TABLE_I, candidates),
        *_shown(tables.reach_table(report, told)),
        "<h3>Curves</h3>",
        html_figure(svg_of(draw_curves(report, told), f"curves-{name}")),
        *_shown(tables.calibration_table(report, told)),
        *(_folded(shown) for shown in tables.breakdown_tables(report, told)),
    ]


def _grids(report: Report, part: Report) -> list[str]:
    grids = part["grids"]
    if grids is None:
        return [f"<h2>Table III left out</h2><p>{escape(part['no_grids'])}</p>"]
    return [
        *_shown(tables.grids_table(report, grids), "h2"),
        *_shown(tables.comparison_table(grids["comparisons"], "whole grids"), kind="text"),
        *_order(report, grids["differences"], tables.TABLE_III, "whole grids"),
    ]


def _order(report: Report, differences: Sequence[Report], metrics: Sequence[str], where: str) -> list[str]:
    return [_folded(s, "text") for s in tables.order_tables(report["methods"], differences, metrics, where)]


def _sources(report: Report) -> Iterable[str]:
    yield "<h2>Runs and checkpoints</h2>"
    sources = [
        (run["place"], part["label_source"], part["split"], part["candidates"], str(part["per_scene"]),
         part["spec_hash"])
        for run in report["runs"] for part in run["parts"]
    ]  # fmt: skip
    yield html_table(
        ("run", "labels", "split", "candidates", "candidates per scene", "specification"), sources, "text"
    )
    checkpoints = [
        (record["name"], checkpoint["place"], checkpoint["model"], checkpoint["sha256"])
        for record in report["methods"]
        if (checkpoint := record["checkpoint"])
    ]
    if checkpoints:
        yield html_table(("method", "checkpoint", "model", "sha256"), checkpoints, "text")
    if report["fitted_on"]:
        yield f"<p>Baselines were fitted on {escape(', '.join(report['fitted_on']))}.</p>"
    yield f"<p class=note>datagen {escape(report['datagen'])}</p>"


def _shown(shown: TitledTable | None, level: str = "h3", first: str = "", kind: str = "") -> list[str]:
    """Heading, whatever comes first, and the table; nothing where it has no rows."""
    if shown is None or not shown.rows:
        return []
    return [f"<{level}>{escape(shown.title)}</{level}>", first, html_table(shown.heads, shown.rows, kind)]


def _folded(shown: TitledTable, kind: str = "") -> str:
    table = html_table(shown.heads, shown.rows, kind)
    return f"<details><summary>{escape(shown.title)}</summary>{table}</details>"
