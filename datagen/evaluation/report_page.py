"""An evaluation in one order: its tables for a terminal, and with figures as one HTML page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from datagen.console.printing import print_rows
from datagen.display.html_page import escape, html_facts, html_figure, html_page, html_table
from datagen.evaluation.columns import Columns
from datagen.evaluation.report_tables import (
    Report,
    Table,
    grid_tables,
    loop_tables,
    notes,
    set_tables,
)
from datagen.evaluation.summary import summary_tables

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
