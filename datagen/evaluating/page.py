"""An evaluation as one HTML page that needs nothing beside it: tables, curves, and grids of a few scenes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from datagen.evaluating.curves import draw_curves, draw_intervals
from datagen.evaluating.grid_pictures import draw_examples
from datagen.evaluating.svg import svg_of
from datagen.evaluating.wording import (
    METRIC_WORDS,
    candidates_line,
    compared,
    grids_line,
    method_label,
    metres_with_interval,
    models_first,
    paper_accuracy,
    percent,
    with_interval,
)
from train.evaluation.columns import Gathered

Report = Mapping[str, Any]

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
    several = len(report["parts"]) > 1
    for number, part in enumerate(report["parts"]):
        if several or part["houses"] == "seen":
            trained = "that were trained on" if part["houses"] == "seen" else "that nobody was trained on"
            body.append(f"<h2>{part['scenes']:,} scenes in houses {trained}</h2>")
        for name, told in part["sets"].items():
            body += _set(report, told, f"{number}-{name}")
        for name, why in part["left_out"].items():
            body.append(f"<h2>Table I: {escape(name)} is left out</h2><p>{escape(why)}</p>")
        body += _grids(report, part)
    if gathered.examples:
        figure = draw_examples(gathered.examples, gathered.columns, report["methods"])
        body += [
            "<h2>Example grids</h2>",
            "<p class=note>Drawn at random from the whole grids with a good candidate. Truth: green is good, "
            "pale is clear and bad, grey has no room for the base; scores are shown where it is clear, red "
            "to green. The star is the pick, rimmed red where it is bad; the dashed circle is the arm's "
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


def _about(report: Report) -> str:
    runs = ", ".join(run["place"] for run in report["runs"])
    boot = report["bootstrap"]
    lines = [
        f"Labels of {escape(runs)}. Intervals: {100 * boot['level']:g}% by {boot['resamples']:,} resamples "
        f"of scenes, seed {boot['seed']}; + says that two intervals have nothing in common.",
        f"The paper's numbers ({escape(report['paper']['source'])}) are of other houses, arms, candidates.",
    ]
    if any(record["threshold"] is None for record in report["methods"]):
        lines.append("* has no threshold: its pick of a robot's candidates is good, all others are bad.")
    lines += [f"{escape(r['name'])}: {escape(r['note'])}." for r in report["methods"] if r["note"]]
    lines += [f"{escape(name)} is left out: {escape(why)}." for name, why in report["left_out"].items()]
    return "".join(f"<p class=note>{line}</p>" for line in lines)


def _set(report: Report, told: Report, name: str) -> list[str]:
    metrics = [metric for metric in METRIC_WORDS if metric != "good"]
    rows = [
        (
            method_label(record),
            *(with_interval(told["methods"][record["name"]][metric]) for metric in metrics),
            percent(paper_accuracy(record, report["paper"])),
        )
        for record in report["methods"]
    ]
    return [
        f"<h2>Table I: {escape(candidates_line(told))}</h2>",
        svg_of(draw_intervals(report, told), f"intervals-{name}"),
        _table(("method", *(METRIC_WORDS[m] for m in metrics), "paper, accuracy"), rows),
        *_order(report, told["differences"], metrics),
        *_reach(report, told),
        "<h3>Curves</h3>",
        svg_of(draw_curves(report, told), f"curves-{name}"),
        *_calibration(report, told),
        *_breakdown(report, told),
    ]


def _order(report: Report, differences: Sequence[Report], metrics: Sequence[str]) -> list[str]:
    out: list[str] = []
    for metric in metrics:
        rows = [
            (record["name"], *("; ".join(names) or "-" for names in said.values()))
            for record in report["methods"]
            if any((said := compared(differences, metric, record["name"])).values())
        ]
        if rows:
            table = _table(("method", "above", "not told apart from", "below"), rows, "text")
            out.append(_folded(f"Who is above whom by {METRIC_WORDS[metric]}", table))
    return out


def _reach(report: Report, told: Report) -> list[str]:
    inside, outside = told["in_reach"], told["out_of_reach"]
    if not outside["count"]:
        return []
    rows = [
        (
            record["name"],
            with_interval(told["methods"][record["name"]]["accuracy_in_reach"]),
            with_interval(told["methods"][record["name"]]["accuracy_out_of_reach"]),
            percent(paper_accuracy(record, report["paper"])) if record["regime"] else "-",
            percent(report["paper"]["accuracy_out_of_reach"]) if record["regime"] == "two-stage" else "-",
        )
        for record in models_first(report["methods"])
    ]
    words = f"{inside['count']:,} candidates within reach (R_in) and {outside['count']:,} beyond (R_out)"
    heads = ("method", "accuracy, R_in", "accuracy, R_out", "paper, all", "paper, R_out")
    return [f"<h3>Table II: {words}</h3>", _table(heads, rows)]


def _calibration(report: Report, told: Report) -> list[str]:
    rows = [
        (record["name"], f"{said['brier']:.4f}", f"{said['expected_calibration_error']:.4f}")
        for record in report["methods"]
        if (said := told["methods"][record["name"]])["brier"] is not None
    ]
    return [_table(("method", "Brier score", "expected calibration error"), rows)] if rows else []


def _breakdown(report: Report, told: Report) -> list[str]:
    names = [record["name"] for record in models_first(report["methods"])]
    out: list[str] = []
    for heading in dict.fromkeys(row["by"] for row in told["breakdown"]):
        rows = [
            (
                row["group"],
                f"{row['count']:,}",
                percent(row["positives"] / row["count"]),
                *(percent(row["methods"][name]["accuracy"]) for name in names),
            )
            for row in told["breakdown"]
            if row["by"] == heading
        ]
        table = _table((heading, "count", "good", *names), rows)
        out.append(_folded(f"Accuracy by {heading}", table))
    return out


def _grids(report: Report, part: Report) -> list[str]:
    grids = part["grids"]
    if grids is None:
        return [f"<h2>Table III is left out</h2><p>{escape(part['no_grids'])}</p>"]
    paper = report["paper"]
    rows = [
        (
            record["name"],
            with_interval(grids["methods"][record["name"]]["good"]),
            metres_with_interval(grids["methods"][record["name"]]["missed_m"]),
            f"{record['seconds_per_600']:.2g}",
        )
        for record in models_first(report["methods"])
    ]
    rows += [
        ("any clear candidate", percent(grids["any_clear"]), "-", "-"),
        ("the paper, two-stage", percent(paper["grid_selection"]), f"{paper['grid_miss_m']:.2f}",
         f"{paper['seconds_per_600']:g}, RTX 4090 laptop GPU"),
    ]  # fmt: skip
    heads = ("method", "its best clear candidate is good", "else missed by (m)", "seconds for 600 candidates")
    return [
        f"<h2>Table III: {escape(grids_line(grids))}</h2>",
        _table(heads, rows),
        *_order(report, grids["differences"], ("good",)),
    ]


def _sources(report: Report) -> Iterable[str]:
    yield "<h2>What this was made from</h2>"
    rows = [
        (run["place"], part["label_source"], part["split"], part["candidates"], str(part["per_scene"]),
         part["spec_hash"])
        for run in report["runs"] for part in run["parts"]
    ]  # fmt: skip
    yield _table(("run", "labels", "split", "candidates", "a scene", "specification"), rows, "text")
    rows = [
        (record["name"], checkpoint["place"], checkpoint["model"], checkpoint["sha256"])
        for record in report["methods"]
        if (checkpoint := record["checkpoint"])
    ]
    if rows:
        yield _table(("method", "checkpoint", "model", "sha256"), rows, "text")
    if report["fitted_on"]:
        yield f"<p>Baselines were fitted on {escape(', '.join(report['fitted_on']))}.</p>"
    yield f"<p class=note>datagen {escape(report['datagen'])}</p>"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    head = "".join(f"<th>{escape(h)}</th>" for h in heads)
    lines = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>\n" for row in rows)
    return f'<table class="{kind}"><tr>{head}</tr>\n{lines}</table>'


def _folded(title: str, inner: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{inner}</details>"
