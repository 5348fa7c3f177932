"""An evaluation as one self-contained HTML page: tables, curves, and grids of a few scenes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from datagen.display.figures import svg_of
from datagen.display.html_page import escape, html_facts, html_figure, html_page, html_table
from datagen.evaluation_report import report_tables as tables
from datagen.evaluation_report.figures import (
    GRIDS_CAPTION,
    draw_curves,
    draw_examples,
    draw_intervals,
)
from datagen.evaluation_report.report_tables import Report, TitledTable
from datagen.train.evaluation.columns import Gathered


def page_of(report: Report, gathered: Gathered) -> str:
    """The whole page."""
    body = [about(report), *tables_of(report)]
    if gathered.examples:
        figure = draw_examples(gathered.examples, gathered.columns, report["methods"])
        body += ["<h2>Example grids</h2>", html_figure(svg_of(figure, "examples"), GRIDS_CAPTION)]
    body += [*sources_of(report)]
    return html_page("Evaluation of base placement", body)


def about(report: Report) -> str:
    """The runs and the notes on the numbers."""
    paths = ", ".join(run["place"] for run in report["runs"])
    return html_facts([("labels", paths), *tables.notes(report)])


def tables_of(report: Report, name: str = "", level: int = 2) -> list[str]:
    """All tables and curves. `name` makes ids unique on a page; `level` is that of the main headings."""
    body: list[str] = []
    for number, part in enumerate(report["parts"]):
        if title := tables.part_title(report, part):
            body.append(f"<h{level}>{escape(title)}</h{level}>")
        for candidates, scores in part["sets"].items():
            body += _set(report, scores, f"{name}{number}-{candidates}", level)
        for candidates, why in part["left_out"].items():
            body.append(f"<h{level}>Table I: {escape(candidates)} left out</h{level}><p>{escape(why)}</p>")
        body += _grids(report, part, level)
    return body


def _set(report: Report, scores: Report, name: str, level: int) -> list[str]:
    candidates, below = scores["candidates"], level + 1
    return [
        *_shown(
            tables.accuracy_table(report, scores),
            level,
            html_figure(svg_of(draw_intervals(report, scores), f"intervals-{name}")),
        ),
        *_shown(tables.comparison_table(scores["comparisons"], candidates), below, kind="text"),
        *_order(report, scores["differences"], tables.TABLE_I, candidates),
        *_shown(tables.reach_table(report, scores), below),
        f"<h{below}>Curves</h{below}>",
        html_figure(svg_of(draw_curves(report, scores), f"curves-{name}")),
        *_shown(tables.calibration_table(report, scores), below),
        *(_folded(shown) for shown in tables.breakdown_tables(report, scores)),
    ]


def _grids(report: Report, part: Report, level: int) -> list[str]:
    grids = part["grids"]
    if grids is None:
        return [f"<h{level}>Table III left out</h{level}><p>{escape(part['no_grids'])}</p>"]
    return [
        *_shown(tables.arrival_table(report, grids), level),
        *_shown(tables.grids_table(report, grids), level),
        *_shown(tables.comparison_table(grids["comparisons"], "whole grids"), level + 1, kind="text"),
        *_order(report, grids["differences"], tables.TABLE_III, "whole grids"),
    ]


def _order(report: Report, differences: Sequence[Report], metrics: Sequence[str], where: str) -> list[str]:
    return [_folded(s, "text") for s in tables.order_tables(report["methods"], differences, metrics, where)]


def sources_of(report: Report, level: int = 2) -> Iterable[str]:
    """The runs, checkpoints and program behind the numbers."""
    yield f"<h{level}>Runs and checkpoints</h{level}>"
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


def _shown(shown: TitledTable | None, level: int, first: str = "", kind: str = "") -> list[str]:
    """Heading, the HTML `first`, and the table; nothing where it has no rows."""
    if shown is None or not shown.rows:
        return []
    return [f"<h{level}>{escape(shown.title)}</h{level}>", first, html_table(shown.heads, shown.rows, kind)]


def _folded(shown: TitledTable, kind: str = "") -> str:
    table = html_table(shown.heads, shown.rows, kind)
    return f"<details><summary>{escape(shown.title)}</summary>{table}</details>"
