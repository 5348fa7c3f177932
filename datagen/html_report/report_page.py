"""The page of a report: an overview with the findings, then a section for each path."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen import __version__
from datagen.console.options import AssetSources
from datagen.console.printing import counted, seconds
from datagen.display.html_page import escape, html_page
from datagen.display.progress import steps
from datagen.evaluation_report.page import about, sources_of, tables_of
from datagen.evaluation_report.report_tables import percent
from datagen.html_report.checkpoint_section import checkpoint_section, read_head
from datagen.html_report.checkpoint_section import state_words as checkpoint_words
from datagen.html_report.cost_section import agreement_section, cost_section
from datagen.html_report.evaluation_file import read_evaluation
from datagen.html_report.outliers import Outlier
from datagen.html_report.part_columns import chosen_shards, read_columns
from datagen.html_report.report_paths import ReportPaths
from datagen.html_report.run_section import PartReport, run_section, state_words
from datagen.html_report.scene_view import SCRIPT, STYLE

_MOST_FINDINGS = 12
_STYLE = f"""{STYLE}
pre {{ overflow-x: auto; max-width: 100%; font-size: .82rem; background: var(--band); padding: .5rem;
  border-radius: 5px; }}
li {{ overflow-wrap: anywhere; }}
table.overview td {{ white-space: normal; }}
@media (max-width: 40rem) {{
  table.overview, table.overview tr, table.overview td {{ display: block; overflow-wrap: anywhere; }}
  table.overview tr:first-child {{ display: none; }}
  table.overview td {{ border: 0; padding: .1rem 0; }}
  table.overview td:not(:first-child)::before {{ content: attr(data-head) ": "; color: var(--pale); }}
  table.overview tr {{ border-bottom: 1px solid var(--line); padding: .4rem 0; }}
}}
a {{ color: var(--accent); }}
h4 {{ margin: .8rem 0 .2rem; overflow-wrap: anywhere; }}
h2, h3 {{ scroll-margin-top: .5rem; }}
"""


@dataclass(frozen=True, eq=False)
class _Section:
    """One section of the page: its id, heading, row of the overview, findings, and HTML."""

    id: str
    heading: str
    row: tuple[str, str, str, str]  # of the overview: contents, positive or accuracy, state, cost
    findings: Sequence[str]
    body: Sequence[str]


def report_page(
    paths: ReportPaths,
    costs: Mapping[str, Mapping[str, Any]],
    pairs: Sequence[Mapping[str, Any]],
    scenes: int,
    seed: int,
    given: AssetSources,
) -> str:
    """The whole page.

    `costs` has the audit of each run by its address and `pairs` the agreement of runs, as `datagen audit`
    computes them. `scenes` is the number of scenes to show a run, `seed` that of the shards to read.
    """
    sections = [*_runs(paths, costs, scenes, seed, given)]
    sections += [_checkpoint(k, path) for k, path in enumerate(paths.checkpoints)]
    sections += [_evaluation(k, path) for k, path in enumerate(paths.evaluations)]
    body = _overview(sections)
    if agreement := agreement_section(pairs):
        body += ["<h2>Agreement</h2>", *agreement]
    for section in sections:
        body += [f'<h2 id="{section.id}">{escape(section.heading)}</h2>', *section.body]
    body.append(f"<p class=note>datagen {escape(__version__)}</p>")
    return html_page("Report of labels and models", body, _STYLE, SCRIPT)


def _overview(sections: Sequence[_Section]) -> list[str]:
    names = ("holds", "positive, or accuracy", "state", "cost")
    heads = "".join(f"<th>{name}</th>" for name in ("", *names))
    rows = "".join(
        f'<tr><td><a href="#{s.id}">{escape(s.heading)}</a></td>'
        + "".join(
            f'<td data-head="{name}">{escape(cell or "-")}</td>'
            for name, cell in zip(names, s.row, strict=True)
        )
        + "</tr>"
        for s in sections
    )
    body = [
        f'<div class="scroll" tabindex="0"><table class="text overview"><tr>{heads}</tr>{rows}</table></div>'
    ]
    findings = [(s, text) for s in sections for text in s.findings]
    body.append("<h2>Worth a look</h2>")
    if not findings:
        return [
            *body,
            "<p>Nothing stands out: no quarantine, no failed attempt, no shard unlike the others.</p>",
        ]
    items = (
        f'<li><a href="#{s.id}">{escape(s.heading)}</a>: {escape(text)}</li>'
        for s, text in findings[:_MOST_FINDINGS]
    )
    more = len(findings) - _MOST_FINDINGS
    return [
        *body,
        f"<ul>{''.join(items)}</ul>",
        f"<p>And {more} more, in the sections.</p>" if more > 0 else "",
    ]


def _runs(
    paths: ReportPaths, costs: Mapping[str, Mapping[str, Any]], scenes: int, seed: int, given: AssetSources
) -> list[_Section]:
    parts = [part for _, of_path in paths.runs for part in of_path]
    reports: list[PartReport] = []
    with steps("shards", sum(len(chosen_shards(part, seed)) for part in parts)) as step:
        for k, part in enumerate(parts):
            reports.append(PartReport(f"run-{k}", part, read_columns(part, seed, step)))
    wanted = [min(scenes, len(r.columns.shard)) if r.columns is not None else 0 for r in reports]
    with steps("scenes", sum(wanted)) as step:
        return [
            _run(report, costs.get(report.part.address), count, given, step)
            for report, count in zip(reports, wanted, strict=True)
        ]


def _run(
    report: PartReport,
    cost: Mapping[str, Any] | None,
    scenes: int,
    given: AssetSources,
    step: Callable[[], None],
) -> _Section:
    part = report.part
    spent = f"{seconds(cost['useful']['cpu_s'])} CPU" if cost is not None else "-"
    source = part.spec.label_source
    return _Section(
        report.name,
        f"Run {part.address}",
        (f"{counted(part.labels, 'label')} by {source}", report.positive, state_words(report), spent),
        _findings(report),
        run_section(report, cost_section(cost) if cost is not None else [], scenes, given, step),
    )


def _findings(report: PartReport) -> list[str]:
    """The findings for the overview, the most serious first."""
    found = [
        f"shard {r.shard} is in quarantine: {r.causes[-1] if r.causes else 'unknown cause'}"
        for r in report.quarantine[:3]
    ]
    if len(report.quarantine) > 3:
        found.append(f"{len(report.quarantine) - 3} more shards are in quarantine")
    if report.status and (missing := report.status["shards"]["missing"]):
        found.append(f"{counted(missing, 'shard')} missing: `datagen resume` makes them")
    if report.status and (failed := sum(row["attempts"] for row in report.status["budgets"])):
        found.append(f"{counted(failed, 'attempt')} failed")
    measures = {m.name: m for m in report.measures}

    def words(o: Outlier) -> str:
        measure = measures[o.measure]
        value, median = measure.text(o.value), measure.text(measure.median)
        return f"shard {report.part.shards[o.row]}: {o.measure} {value}, median {median} (z {o.score:+.1f})"

    return found + [words(o) for o in report.outliers[:3]]


def _checkpoint(k: int, path: Path) -> _Section:
    head, name = read_head(path), f"checkpoint-{k}"
    best = [r for r in head.history if r["epoch"] == head.best_epoch]
    accuracy = f"{percent(best[0]['val_accuracy'])}% (validation)" if best else "-"
    spent = f"{seconds(head.cost['train_cpu_s'])} CPU" if "train_cpu_s" in head.cost else "-"
    return _Section(
        name,
        f"Checkpoint {path}",
        (f"{head.model}, {head.stage}", accuracy, checkpoint_words(head), spent),
        [] if head.finished else ["training is not finished"],
        checkpoint_section(path, head, name),
    )


def _evaluation(k: int, path: Path) -> _Section:
    report, name = read_evaluation(path), f"evaluation-{k}"
    first = next(iter(report["parts"][0]["sets"].values()), None) if report["parts"] else None
    best = "-"
    if first is not None:
        scored = [(m["accuracy"]["value"] or 0.0, method) for method, m in first["methods"].items()]
        value, method = max(scored)
        best = f"{percent(value)}% ({method}, {first['candidates']})"
    return _Section(
        name,
        f"Evaluation {path}",
        (counted(len(report["methods"]), "method"), best, "", "-"),
        [],
        [about(report), *tables_of(report, f"{name}-", level=3), *sources_of(report, level=3)],
    )
