"""`datagen report`: runs, checkpoints and evaluations as one HTML page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from datagen.console.options import AS_FOUND, AssetSources, Whole, refuse_output
from datagen.console.printing import counted, print_rows, size
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.whole_files import whole_file

_MOST_SCENES = 50


def report(
    paths: Annotated[list[str], Parameter(name="PATH...")],
    /,
    *,
    out: Path,
    scenes: Whole = 8,
    seed: Whole = 0,
    given: AssetSources = AS_FOUND,
) -> int:
    """Write one HTML page about runs, checkpoints and evaluations. It opens offline.

    It shows what was made and from what, cost and waste, label balance, agreement of runs over the same
    candidates, failures and quarantine, shards and scenes that stand out, and scenes in 3D. Large runs are
    sampled: 256 random shards or 400,000 labels; the page notes where. Pictures need the houses and objects.

    For example: datagen report runs/first model.ckpt evaluation.json --out report.html

    Args:
        paths: Runs, sealed stores, checkpoints or released, and documents of datagen evaluate --json.
        out: Page to write: FILE.html.
        scenes: Scenes to show of each run, the most unusual first.
        seed: Seed of the sample of a large run.
    """
    if not paths:
        raise InputError("datagen report", "PATH", "is missing", "Name one or more runs")
    refuse_output(out, "--out", ".html", ".htm")
    if not 0 <= scenes <= _MOST_SCENES:
        raise InputError(
            "--scenes", str(scenes), f"is not between 0 and {_MOST_SCENES}", "Give 8, or 0 for none"
        )
    if seed < 0:
        raise InputError("--seed", str(seed), "is below 0", "Give 0 or more")
    # Imported here, so that other verbs do not wait for matplotlib.
    from datagen.html_report.report_page import report_page
    from datagen.html_report.report_paths import open_report_paths

    opened = open_report_paths(paths)
    runs = [part.run for _, parts in opened.runs for part in parts if part.run is not None]
    page = report_page(opened, _costs(runs), _agreement(runs), scenes, seed, given).encode()
    with whole_file(out, alone=True) as file:
        file.write(page)
    named = {"run": opened.runs, "checkpoint": opened.checkpoints, "evaluation": opened.evaluations}
    about = ", ".join(counted(len(found), kind) for kind, found in named.items() if found)
    print_rows("report", [("about", about), ("page", f"{out} ({size(len(page))})")])
    return 0


def _costs(runs: Sequence[Run]) -> dict[str, Mapping[str, Any]]:
    """The audit of each run by its address."""
    from datagen.reports.label_costs import audit_report
    from datagen.reports.spending import account_for

    return {run.storage.url: audit_report(account_for([run]), run.manifest.spec.label_source) for run in runs}


def _agreement(runs: Sequence[Run]) -> list[Mapping[str, Any]]:
    """The agreement of every two runs over the same candidates: over all, and over those within reach."""
    from datagen.reports.agreement import read_labelled
    from datagen.reports.label_costs import costs_of_runs
    from datagen.reports.paired_runs import AuditedRun, fidelity, pairs
    from datagen.reports.spending import account_for

    # Labels are read only from runs that share their candidates with another.
    shared = Counter(run.manifest.spec.scenes_hash for run in runs)
    ordered = sorted(
        (run for run in runs if shared[run.manifest.spec.scenes_hash] > 1),
        key=lambda run: fidelity(run.manifest.spec),
    )
    spendings = [account_for([run]) for run in ordered]
    audited = [
        AuditedRun(run, read_labelled(run), cost, spending.wall_s_per_label)
        for run, cost, spending in zip(ordered, costs_of_runs(ordered, spendings), spendings, strict=True)
    ]
    everywhere, near = pairs(audited, "grid"), pairs(audited, "in-range")
    # Where all candidates lie within reach, the two are the same.
    return [*everywhere, *(b for a, b in zip(everywhere, near, strict=True) if a["count"] != b["count"])]
