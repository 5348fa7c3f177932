"""An evaluation in one order: its tables for a terminal, and with figures as one HTML page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from datagen.console.printing import print_rows
from datagen.display.html_page import escape, html_facts, html_figure, html_page, html_table
from datagen.evaluation.columns import Columns
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

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Picture:
    """A figure to draw, with its caption."""

    draw: Callable[[], Figure]
    caption: str


def print_evaluation(report: Report, full: bool) -> None:
    """Print the tables, except details, and the notes; without `full` one short table of each part."""
    if not full:
        for table in summary_tables(report):
            print_rows(table.title, table.rows, table.heads)
        return
    for block in blocks(report):
        if isinstance(block, str):
            print_rows(block, [])
        elif isinstance(block, Table) and not block.detail:
            print_rows(block.title, block.rows, block.heads)
    print_rows("notes", notes(report))


def page_of(report: Report, columns: Columns) -> str:
    """The whole page. `columns` has the example grids."""
    from datagen.display.figures import svg_of

    body = [html_facts(notes(report))]
    for k, block in enumerate(blocks(report, columns)):
        if isinstance(block, str):
            body.append(f"<h2>{escape(block)}</h2>")
        elif isinstance(block, Picture):
            body.append(html_figure(svg_of(block.draw(), f"figure-{k}"), block.caption))
        elif block.rows:
            table = html_table(block.heads, block.rows)
            title = escape(block.title)
            folded = f"<details><summary>{title}</summary>{table}</details>"
            body.append(folded if block.detail else f"<h3>{title}</h3>{table}")
    body.append(f"<p class=note>datagen {escape(report['datagen'])}</p>")
    benchmark = report.get("benchmark")
    subject = (
        f"Base placement benchmark {benchmark['version']}" if benchmark else "Evaluation of base placement"
    )
    return html_page(subject, body)


def blocks(report: Report, columns: Columns | None = None) -> Iterator[str | Table | Picture]:
    """Headings, tables and pictures, in order; pictures are drawn only on demand."""
    from datagen.evaluation import figures

    for part in report["parts"]:
        yield f"{part['title']}: {part['scenes']:,} scenes"
        for scores in part["sets"].values():
            tables = set_tables(report, scores)
            yield next(tables)
            yield Picture(partial(figures.draw_intervals, report, scores), figures.INTERVALS_CAPTION)
            yield from tables
        if part["grids"] is not None:
            yield from grid_tables(report, part["grids"])
        yield Table("omitted", ("table", "reason"), list(part["left_out"].items()))
    if "closed_loop" in report:
        yield "Closed loop"
        tables = loop_tables(report)
        yield next(tables)
        yield Picture(partial(figures.draw_loop, report), figures.LOOP_CAPTION)
        yield from tables
    if columns is not None and len(scenes := figures.example_scenes(columns)):
        yield "Example grids"
        draw = partial(figures.draw_examples, scenes, columns, report["methods"])
        yield Picture(draw, figures.GRIDS_CAPTION)


_SHOWN = ("balanced_accuracy", "area_under_roc", "accuracy")
_BASELINES = 3


def summary_tables(report: Report) -> Iterator[Table]:
    """One table of each part and, of a closed loop, its success."""
    for part in report["parts"]:
        for scores in list(part["sets"].values())[:1]:
            yield _decisions(report, part, scores)
        if not part["sets"] and part["grids"] is not None:
            yield _choices(report, part)
    if "closed_loop" in report:
        yield next(loop_tables(report))


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
