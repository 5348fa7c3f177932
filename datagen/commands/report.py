"""`datagen report`: runs and checkpoints as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from datagen.console.options import refuse_output
from datagen.console.printing import print_rows, size
from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import whole_file


def report(paths: Annotated[list[str], Parameter(name="PATH...")], /, *, out: Path) -> int:
    """Write one HTML page about runs and models. It opens offline.

    For a run: what was made, its labels on the floor around the target, causes of failure, cost, three scenes
    and provenance. For a model: accuracy, course of training, data, cost and provenance.

    For example: datagen report runs/first released --out report.html

    Args:
        paths: Runs, and checkpoints of datagen train or released.
        out: Page to write: FILE.html.
    """
    if not paths:
        raise InputError("datagen report", "PATH", "is missing", "Name one or more runs")
    refuse_output(out, "--out", ".html", ".htm")
    # Imported here, so that other verbs do not wait for matplotlib.
    from datagen.html_report.report_page import report_page

    page = report_page(paths).encode()
    with whole_file(out, alone=True) as file:
        file.write(page)
    print_rows("report", [("about", ", ".join(paths)), ("page", f"{out} ({size(len(page))})")])
    return 0
