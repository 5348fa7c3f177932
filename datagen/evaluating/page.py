"""An evaluation as one self-contained HTML page: tables, curves, and grids of a few scenes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape as html_escape

from datagen.evaluating import rows
from datagen.evaluating.curves import draw_curves, draw_intervals
from datagen.evaluating.grid_pictures import draw_examples
from datagen.evaluating.rows import Shown
from datagen.evaluating.svg import svg_of
from datagen.evaluating.wording import Report
from datagen.schemas.errors import printable
from datagen.train.evaluation.columns import Gathered

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1c1c; margin: 2rem auto; max-width: 76rem;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.25rem; margin-top: 2.4rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1.05rem; margin-bottom: .3rem; }
table { border-collapse: collapse; margin: .4rem 0 1.2rem; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .8rem .15rem 0; text-align: right; vertical-align: top; }
th { font-weight: 600; border-bottom: 1px solid #999; } td { border-bottom: 1px solid #eee; }
th:first-child, td:first-child, table.text td, table.text th { text-align: left; }
svg { max-width: 100%; height: auto; } p.note, summary { color: #555; }
code { font-size: 88%; overflow-wrap: anywhere; }
"""


def page_of(report: Report, gathered: Gathered) -> str:
    """The whole page."""
    body: list[str] = ["<h1>Evaluation of base placement</h1>", _about(report)]
    for number, part in enumerate(report["parts"]):
        if title := rows.part_title(report, part):
            body.append(f"<h2>{escape(title)}</h2>")
        for name, told in part["sets"].items():
            body += _set(report, told, f"{number}-{name}")
        for name, why in part["left_out"].items():
            body.append(f"<h2>Table I: {escape(name)} is omitted</h2><p>{escape(why)}</p>")
        body += _grids(report, part)
    if gathered.examples:
        figure = draw_examples(gathered.examples, gathered.columns, report["methods"])
        body += [
            "<h2>Example grids</h2>",
            "<p class=note>Random whole grids with a positive candidate. Labels: green is positive, pale is "
            "clear and negative, grey is not clear. Scores are shown for clear cells, from red to green. The "
            "star is the method's choice, red-rimmed where it is negative; the dashed circle is the arm's "
            "reach; red points are the target.</p>",
            svg_of(figure, "examples"),
        ]
    body += [*_sources(report)]
    head = f'<meta charset="utf-8"><title>Evaluation of base placement</title><style>{_STYLE}</style>'
    return (
        f"<!doctype html>\n<html lang=en><head>{head}</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def escape(text: str) -> str:
    """The text escaped for HTML."""
    return html_escape(printable(text))


def _about(report: Report) -> str:
    places = ", ".join(run["place"] for run in report["runs"])
    lines = [f"Labels of {places}.", *(f"{name}: {words}." for name, words in rows.notes(report))]
    return "".join(f"<p class=note>{escape(line)}</p>" for line in lines)


def _set(report: Report, told: Report, name: str) -> list[str]:
    candidates = told["candidates"]
    return [
        *_shown(
            rows.accuracy_table(report, told), "h2", svg_of(draw_intervals(report, told), f"intervals-{name}")
        ),
        *_shown(rows.comparison_table(told["comparisons"], candidates), kind="text"),
        *_order(report, told["differences"], rows.TABLE_I, candidates),
        *_shown(rows.reach_table(report, told)),
        "<h3>Curves</h3>",
        svg_of(draw_curves(report, told), f"curves-{name}"),
        *_shown(rows.calibration_table(report, told)),
        *(_folded(shown) for shown in rows.breakdown_tables(report, told)),
    ]


def _grids(report: Report, part: Report) -> list[str]:
    grids = part["grids"]
    if grids is None:
        return [f"<h2>Table III is omitted</h2><p>{escape(part['no_grids'])}</p>"]
    return [
        *_shown(rows.grids_table(report, grids), "h2"),
        *_shown(rows.comparison_table(grids["comparisons"], "whole grids"), kind="text"),
        *_order(report, grids["differences"], rows.TABLE_III, "whole grids"),
    ]


def _order(report: Report, differences: Sequence[Report], metrics: Sequence[str], where: str) -> list[str]:
    return [_folded(s, "text") for s in rows.order_tables(report["methods"], differences, metrics, where)]


def _sources(report: Report) -> Iterable[str]:
    yield "<h2>Inputs</h2>"
    sources = [
        (run["place"], part["label_source"], part["split"], part["candidates"], str(part["per_scene"]),
         part["spec_hash"])
        for run in report["runs"] for part in run["parts"]
    ]  # fmt: skip
    yield _table(("run", "labels", "split", "candidates", "per scene", "specification"), sources, "text")
    checkpoints = [
        (record["name"], checkpoint["place"], checkpoint["model"], checkpoint["sha256"])
        for record in report["methods"]
        if (checkpoint := record["checkpoint"])
    ]
    if checkpoints:
        yield _table(("method", "checkpoint", "model", "sha256"), checkpoints, "text")
    if report["fitted_on"]:
        yield f"<p>Baselines were fitted on {escape(', '.join(report['fitted_on']))}.</p>"
    yield f"<p class=note>datagen {escape(report['datagen'])}</p>"


def _shown(shown: Shown | None, level: str = "h3", first: str = "", kind: str = "") -> list[str]:
    """Heading, introduction and table; empty where the table has no rows."""
    if shown is None or not shown.rows:
        return []
    return [f"<{level}>{escape(shown.title)}</{level}>", first, _table(shown.heads, shown.rows, kind)]


def _folded(shown: Shown, kind: str = "") -> str:
    table = _table(shown.heads, shown.rows, kind)
    return f"<details><summary>{escape(shown.title)}</summary>{table}</details>"


def _table(heads: Sequence[str], lines: Iterable[Sequence[str]], kind: str = "") -> str:
    head = "".join(f"<th>{escape(h)}</th>" for h in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in line) + "</tr>\n" for line in lines)
    return f'<table class="{kind}"><tr>{head}</tr>\n{body}</table>'
