"""`datagen audit`: what runs made, its cost and waste."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from datagen.console.options import AsJson
from datagen.console.printing import print_json
from datagen.reports.audit import audit_runs, print_audit
from datagen.schemas.errors import InputError
from datagen.schemas.run import open_runs


def audit(
    runs: Annotated[list[str], Parameter(name="RUN...")], /, *, full: bool = False, json: AsJson = False
) -> int:
    """Show what was made, what it cost per label, and what was wasted.

    Costs are core time: CPU seconds, and the wall time of killed attempts. A label costs its run's whole
    cost, waste included, divided by the labels of that kind. Name the run that made the scenes beside runs of
    --scenes-from: its scenes are then charged in proportion, and labels of the same candidates are compared.
    Exit code 1 where the ledger does not add up to commits and waste.

    For example: datagen audit runs/first

    Args:
        runs: Runs of one or several label sources.
        full: Also show costs by stage and rejected scenes.
    """
    if not runs:
        raise InputError("datagen audit", "RUN", "is missing", "Name one or more run folders")
    opened = [(number, run) for number, path in enumerate(runs) for run in open_runs(path)]
    first = dict[str, int]()
    for number, run in opened:
        if (other := first.setdefault(run.manifest.spec_hash, number)) != number:
            problem = f"has the specification of {runs[other]}, so labels and costs would count twice"
            raise InputError(runs[number], "", problem, "Name it once, or merge them with `datagen merge`")
    report = audit_runs([run for _, run in opened])
    if json:
        print_json(report)
    else:
        print_audit(report, full)
    return 0 if report["is_exact"] else 1
