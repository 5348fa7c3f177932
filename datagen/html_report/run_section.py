"""The section of one run: contents, provenance, cost, balance, failures, shards, scenes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from datagen.console.options import AssetSources
from datagen.console.printing import counted, listed
from datagen.display.figures import svg_of
from datagen.display.html_page import escape, html_facts, html_figure, html_table
from datagen.html_report.measures import shard_measures
from datagen.html_report.outliers import FEWEST, THRESHOLD, Measure, Outlier, outliers_of
from datagen.html_report.part_columns import PartColumns
from datagen.html_report.report_paths import ReportedPart
from datagen.html_report.run_figures import BALANCE_CAPTION, SHARDS_CAPTION, draw_balance, draw_shards
from datagen.html_report.unusual_scenes import unusual_scenes
from datagen.reports.run_status import status_report
from datagen.schemas.description import described
from datagen.schemas.outcomes import OUTCOMES
from datagen.schemas.quarantine import lifted_records
from datagen.schemas.run import Run
from datagen.schemas.run_records import Manifest, QuarantineRecord

_MOST_OUTLIERS, _MOST_QUARANTINED = 20, 50


@dataclass(frozen=True, eq=False)
class PartReport:
    """A part with its columns, status and outliers. `name` is unique on the page."""

    name: str
    part: ReportedPart
    columns: PartColumns | None

    @cached_property
    def status(self) -> dict[str, Any]:
        """The status as of `datagen status --stacks`; empty for a sealed store."""
        return {} if self.part.run is None else status_report(self.part.run, stacks=True)

    @cached_property
    def measures(self) -> list[Measure]:
        """Measures of the shards."""
        return shard_measures(self.part, self.columns)

    @cached_property
    def outliers(self) -> list[Outlier]:
        """Shards that stand out; rows are positions in `part.shards`."""
        return outliers_of(self.measures)

    @cached_property
    def quarantine(self) -> list[QuarantineRecord]:
        """Records of the shards in quarantine."""
        return [] if self.part.run is None else self.part.run.quarantine_records()

    @property
    def positive(self) -> str:
        """Share of positive labels: of all commits, or of the labels that were read."""
        made = self.status.get("labels_made")
        if made:
            return f"{100 * self.status['positives'] / made:.1f}%"
        if self.columns is None:
            return "-"
        return f"{100 * self.columns.samples['label'].mean():.1f}%"


def run_section(
    report: PartReport, cost: Sequence[str], scenes: int, given: AssetSources, step: Callable[[], None]
) -> list[str]:
    """The section as HTML below its heading. `cost` is the HTML of its cost; `step` counts scenes."""
    part, columns = report.part, report.columns
    body = [html_facts(_facts(report)), *_provenance(part)]
    if cost:
        body += ["<h3>Cost and waste</h3>", *cost]
    if columns is not None:
        body += [
            "<h3>Label balance</h3>",
            f"<p class=note>From {escape(columns.sample_words)}.</p>",
            html_figure(svg_of(draw_balance(columns), f"{report.name}-balance"), BALANCE_CAPTION),
            *_outcomes(columns),
            "<h3>Shards that stand out</h3>",
            *_shards(report),
        ]
    body += _failures(report)
    if columns is not None and scenes and (shown := unusual_scenes(columns, scenes, given, step)):
        body += ["<h3>Unusual scenes</h3>", *shown]
    return body


def _facts(report: PartReport) -> list[tuple[str, str]]:
    status = report.status
    facts = [("labels", _labels(report)), ("positive", report.positive)]
    if status:
        shards = status["shards"]
        facts += [
            ("state", state_words(report)),
            ("shards", f"{shards['committed']:,} of {shards['planned']:,} committed"),
            ("created", status["created"]),
        ]
    return facts


def _labels(report: PartReport) -> str:
    part, status = report.part, report.status
    sources = " and ".join(dict.fromkeys(spec.label_source for spec in part.specs))
    words = f"{part.labels:,} by {sources}"
    return f"{words} of {status['n']:,} wanted" if status and status["n"] != part.labels else words


def state_words(report: PartReport) -> str:
    """Complete, or what is missing; with the number of quarantined shards."""
    if not report.status:
        return "sealed store without its run"
    shards = report.status["shards"]
    words = [
        "complete" if report.status["complete"] else "",
        f"{counted(shards['missing'], 'shard')} missing" if shards["missing"] else "",
        f"{len(shards['quarantined']):,} in quarantine" if shards["quarantined"] else "",
        "sealed" if report.status["sealed"] else "",
    ]
    return ", ".join(filter(None, words))


def _provenance(part: ReportedPart) -> list[str]:
    about = described(part.specs)
    facts = [("licences", about["license"]), ("references", about["references"])]
    facts += [
        ("specification", f"{spec.hash()}, seed {spec.seed}, split {spec.split}") for spec in part.specs
    ]
    body = ["<h3>Provenance and licences</h3>"]
    if part.run is not None:
        manifest = part.run.manifest
        facts = [("made from", manifest.made_from), *facts, *_origin(manifest)]
    body.append(html_facts(facts))
    if part.run is not None:
        body += _lineage(part.run)
    document = json.dumps([spec.document() for spec in part.specs], indent=2)
    return [*body, f"<details><summary>whole specification</summary><pre>{_lines(document)}</pre></details>"]


def _origin(manifest: Manifest) -> list[tuple[str, str]]:
    engines = ", ".join(f"{k} {v}" for k, v in sorted(manifest.spec.engines.items()))
    libraries = ", ".join(f"{k} {v}" for k, v in sorted(manifest.libraries.items()))
    sources = ", ".join(f"{k} {v}" for k, v in sorted(manifest.sources.items()) if not k.startswith("n_"))
    pairs = (
        ("sources", sources),
        ("program", f"datagen {manifest.code_version} on {manifest.platform}"),
        ("engines", engines),
        ("libraries", libraries),
    )
    return [(head, text) for head, text in pairs if text]


def _lineage(run: Run) -> list[str]:
    from datagen.schemas.lineage import lineage_summary

    rows = [
        (o["address"], f"{o['shards']:,}", o["created"], o["platform"], o["code_version"])
        for o in lineage_summary(run)
    ]
    if not rows:
        return []
    heads = ("merged from", "shards", "created", "platform", "program")
    return [html_table(heads, rows, "text")]


def _outcomes(columns: PartColumns) -> list[str]:
    """Table of outcomes, of all candidates and of those within reach; empty for labels without outcomes."""
    if "outcome" not in columns.samples:
        return []
    codes, near = columns.samples["outcome"], columns.is_in_range
    whole, within = (
        [int((part == code).sum()) for code in range(len(OUTCOMES))] for part in (codes, codes[near])
    )
    rows = [
        (name, stage, f"{whole[k]:,}", _share(whole[k], len(codes)), _share(within[k], int(near.sum())))
        for k, (name, stage) in enumerate(OUTCOMES.items())
        if whole[k]
    ]
    rows.sort(key=lambda row: -int(row[2].replace(",", "")))
    heads = ("outcome", "decided by", "count", "of all", "where the base fits, within reach")
    return ["<h3>Causes of failure</h3>", html_table(heads, rows)]


def _share(count: int, whole: int) -> str:
    return f"{100 * count / whole:.1f}%" if whole else "-"


def _shards(report: PartReport) -> list[str]:
    part, measures = report.part, {m.name: m for m in report.measures}
    if len(part.shards) < FEWEST:
        return [f"<p>{counted(len(part.shards), 'shard')}: too few to find outliers.</p>"]
    rows = [
        (
            str(part.shards[o.row]), o.measure, m.text(o.value), m.text(m.median), f"{o.score:+.1f}",
            _machine(part, part.shards[o.row]),
        )
        for o in report.outliers[:_MOST_OUTLIERS]
        for m in [measures[o.measure]]
    ]  # fmt: skip
    found, some = len(report.outliers), f", the {_MOST_OUTLIERS} largest listed"
    text = (
        f"{counted(found, 'value')} of {counted(len(part.shards), 'shard')} with a robust z-score beyond "
        f"{THRESHOLD:g}{some if found > _MOST_OUTLIERS else ''}."
    )
    table = html_table(("shard", "measure", "value", "median", "z", "machine"), rows) if rows else ""
    figure = draw_shards(part.shards, [m for m in report.measures if m.varies])
    return [f"<p>{text}</p>", table, html_figure(svg_of(figure, f"{report.name}-shards"), SHARDS_CAPTION)]


def _machine(part: ReportedPart, shard: int) -> str:
    commit = part.commits.get(shard)
    return commit.host.name if commit else "-"


def _failures(report: PartReport) -> list[str]:
    """Failed attempts by cause, and the quarantine, with stacks."""
    if report.part.run is None:
        return []
    body: list[str] = []
    causes, stacks = report.status["causes"], report.status["stacks"]
    if causes:
        body.append("<h3>Failed attempts</h3>")
        for cause, count in causes.items():
            body.append(_folded(f"{counted(count, 'attempt')}: {cause}", [stacks.get(cause, "")]))
    lifted = lifted_records(report.part.run)
    body.append("<h3>Quarantine</h3>")
    if not report.quarantine and not lifted:
        return [*body, "<p>No shard is in quarantine.</p>"]
    for records, words in ((report.quarantine, "in quarantine"), (lifted, "released, tried again later")):
        for record in records[:_MOST_QUARANTINED]:
            cause = record.causes[-1] if record.causes else "unknown cause"
            tried = counted(len(record.attempts), "attempt")
            title = f"shard {record.shard} ({words}) after {tried}: {cause}"
            body.append(_folded(title, record.stacks))
        if len(records) > _MOST_QUARANTINED:
            shards = listed([record.shard for record in records[_MOST_QUARANTINED:]])
            body.append(f"<p>And {len(records) - _MOST_QUARANTINED:,} more {words}: shards {shards}</p>")
    return body


def _folded(title: str, stacks: Sequence[str]) -> str:
    """A summary that opens; only a line without a stack."""
    text = "".join(f"<pre>{_lines(stack)}</pre>" for stack in dict.fromkeys(stacks) if stack)
    if not text:
        return f"<p>{escape(title)}</p>"
    return f"<details><summary>{escape(title)}</summary>{text}</details>"


def _lines(text: str) -> str:
    """Escaped text with its line breaks."""
    return "\n".join(escape(line) for line in text.splitlines())
