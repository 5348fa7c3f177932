"""`datagen audit`: the cost of labels, its projection to the paper's 180,000, and their agreement."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from datagen.console.options import AsJson, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.reports.agreement_tables import print_agreement, print_pair
from datagen.reports.audit import audit_runs
from datagen.reports.audit_tables import print_costs, print_source
from datagen.reports.prices import read_prices
from datagen.schemas.errors import InputError
from datagen.schemas.run import open_runs


def audit(
    runs: Annotated[list[str], Parameter(name="RUN...")],
    /,
    *,
    candidates: Literal["grid", "clear", "in-range"] = "grid",
    prices: Path | None = None,
    map: Path | None = None,  # noqa: A002 - the option's name
    json: AsJson = False,
) -> int:
    """Show what labels cost in time and money, the waste, and how far label sources agree.

    Costs are given for a label, a label within reach, a positive and a correct label, and for 180,000.
    Seconds are summed over workers: two workers that are busy for a minute cost two minutes. Runs with
    labels of the same candidates (--scenes-from) are compared pair by pair, and the source of highest
    fidelity is the truth. Where ledger and commits differ, the record is named and the exit code is 1.

    For example: datagen audit runs/first

    Args:
        runs: Runs of one or several label sources.
        candidates: Candidates whose outcomes and agreement are counted; grid: all.
        prices: TOML file with prices. [default: list prices, docs/guides/costs.md]
        map: Picture to write, FILE.svg or FILE.png: where on the floor labels are wrong.
    """
    if not runs:
        raise InputError("datagen audit", "RUN", "is missing", "Name one or more run folders")
    if map is not None:
        refuse_output(map, "--map", ".svg", ".png")
    given = read_prices(prices)
    report = audit_runs([run for path in runs for run in open_runs(path)], candidates, given)
    if map is not None:
        if not report["pairs"]:
            fix = "Make a second run with --scenes-from, and name both"
            raise InputError("datagen audit", "--map", "no two of the runs label the same candidates", fix)
        # Imported here, so that runs are audited without matplotlib.
        from datagen.drawing.error_map_picture import draw_error_maps

        draw_error_maps(report["pairs"], map)
    if json:
        print_json(report)
    else:
        print_costs(report, given)
        print_agreement(report)
        for source in report["sources"]:
            print_source(source, candidates, given)
        for pair in report["pairs"]:
            print_pair(pair)
        if map is not None:
            print_rows("map of wrong labels", [("picture", str(map))])
    return 0 if report["balance"]["exact"] else 1
