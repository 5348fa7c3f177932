"""The section of one run, in the order of a reader's questions: labels, causes, cost, scenes, provenance."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from datagen.console.printing import counted
from datagen.display.figures import svg_of
from datagen.display.html_page import escape, html_facts, html_figure, html_folded, html_table
from datagen.display.styles import OUTCOME_STYLES
from datagen.html_report.figures import FLOOR_CAPTION, draw_floor
from datagen.html_report.run_columns import RunColumns, read_columns
from datagen.reports.audit import audit_runs, cost_rows
from datagen.reports.run_status import status_report
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.shard_files import described
from datagen.schemas.shard_reading import read_scenes
from datagen.workers.extras import missing_library

_SCENES = 3


def run_section(run: Run, name: str) -> Iterator[str]:
    """The section as HTML below its heading; `name` makes its ids unique on the page."""
    status, columns = status_report(run), read_columns(run)
    yield from _made(status, columns)
    if columns is not None:
        yield "<h3>Labels on the floor</h3>"
        yield html_figure(svg_of(draw_floor(columns), name), FLOOR_CAPTION)
    yield from _causes(status, columns)
    yield "<h3>Cost</h3>"
    yield html_table(("", ""), cost_rows(audit_runs([run])["sources"]))
    if columns is not None:
        yield from _scenes(run, columns)
    yield from _provenance(run)


def _made(status: dict[str, Any], columns: RunColumns | None) -> Iterator[str]:
    shards = status["shards"]
    state = [
        "complete" if status["complete"] else "",
        f"{counted(shards['missing'], 'shard')} missing: `datagen resume` makes them"
        if shards["missing"]
        else "",
        f"{counted(len(shards['quarantined']), 'shard')} in quarantine" if shards["quarantined"] else "",
    ]
    source, labels = status["label_source"], status["labels"]
    facts = [("labels", f"{labels:,} of {status['n']:,}, by {source}: {', '.join(filter(None, state))}")]
    if columns is not None:
        good, near = columns.label, columns.is_near
        facts.append(("good", f"{100 * good.mean():.1f}% of all base poses"))
        if near.any() and not near.all():
            share = f"{100 * good[near].mean():.1f}% of the {100 * near.mean():.0f}%"
            facts.append(("", f"{share} where the base fits and the target is within reach"))
        if columns.shards < columns.of:
            facts.append(
                ("read", f"{columns.shards} of {columns.of} shards, evenly spaced, for what follows")
            )
    yield html_facts([*facts, ("from", status["made_from"]), ("created", status["created"])])


def _causes(status: dict[str, Any], columns: RunColumns | None) -> Iterator[str]:
    yield "<h3>Causes of failure</h3>"
    if columns is not None:
        near = columns.is_near
        counts = [
            (name, int(rows.sum()), int((rows & near).sum())) for name, rows in columns.causes().items()
        ]
        table = [
            (_words(name), f"{count:,}", _share(count, len(near)), _share(reached, int(near.sum())))
            for name, count, reached in sorted(counts, key=lambda row: -row[1])
            if count
        ]
        yield html_table(("outcome", "base poses", "of all", "within reach"), table)
        yield "<p class=note>Within reach: the base fits, and the target is nearer than the arm is long.</p>"
    failed = [f"{counted(count, 'attempt')}: {cause}" for cause, count in status["causes"].items()]
    held = [
        f"shard {q['shard']} is in quarantine: {q['cause'] or 'unknown cause'}" for q in status["quarantine"]
    ]
    lines = "".join(f"<li>{escape(text)}</li>" for text in [*held, *failed])
    yield f"<ul>{lines}</ul>" if lines else "<p>No attempt failed, and no shard is in quarantine.</p>"


def _words(cause: str) -> str:
    return f"{cause}: {OUTCOME_STYLES[cause].words}" if cause in OUTCOME_STYLES else cause


def _share(count: int, whole: int) -> str:
    return f"{100 * count / whole:.1f}%" if whole else "-"


def _scenes(run: Run, columns: RunColumns) -> Iterator[str]:
    yield f"<h3>{counted(min(_SCENES, len(columns.scenes)), 'scene')}</h3>"
    rows = np.unique(np.linspace(0, len(columns.scenes) - 1, _SCENES).astype(int))
    scenes = list(read_scenes(run, columns.scenes[rows].tolist()))
    try:
        # Pictures need the extra labels, the rest of the page does not.
        from datagen.html_report.scenes import scene_sections

        yield f'<div class="pictures">{"".join(scene_sections(run, scenes))}</div>'
    except InputError as error:
        yield f"<p>Without pictures: {escape(str(error))}</p>"
    except ImportError as error:
        if (missing := missing_library(error)) is None:
            raise
        yield f"<p>Without pictures: {escape(str(missing))}</p>"


def _provenance(run: Run) -> Iterator[str]:
    manifest, spec = run.manifest, run.manifest.spec
    about = described([spec], [manifest.sources])
    pairs = (manifest.sources, spec.engines, manifest.libraries)
    sources, engines, libraries = (", ".join(f"{k} {v}" for k, v in sorted(d.items())) for d in pairs)
    facts = [
        ("licences", about["license"]),
        ("references", about["references"]),
        ("specification", f"{spec.hash()}, seed {spec.seed}, split {spec.split}"),
        ("sources", sources),
        ("program", f"datagen {manifest.code_version} on {manifest.platform}"),
        ("engines", engines),
        ("libraries", libraries),
    ]
    yield "<h3>Provenance</h3>" + html_facts((head, text) for head, text in facts if text)
    yield html_folded("whole specification", json.dumps(spec.document(), indent=2))
