"""Files and printed tables of an evaluation, for the verbs that make one."""

from __future__ import annotations

import json as json_format
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from datagen.console.options import refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.schemas.safe_files import whole_file

if TYPE_CHECKING:
    from datagen.evaluation.columns import Columns

Outputs = Annotated[Sequence[str | Path] | None, Parameter(metavar="PATH")]


def output_files(out: Sequence[str | Path] | None) -> list[Path]:
    """The files of --out. InputError for another ending, or a folder that does not exist."""
    files = [Path(file) for file in out or ()]
    for file in files:
        refuse_output(file, "--out", ".json", ".html")
    return files


def write_report(report: dict[str, Any], columns: Columns, files: Sequence[Path]) -> None:
    """Write the report to each of the files."""
    from datagen.evaluation.report_page import page_of

    for file in files:
        with whole_file(file, alone=True) as stream:
            if file.suffix.lower() == ".html":
                stream.write(page_of(report, columns).encode())
            else:
                stream.write((json_format.dumps(report, indent=1, allow_nan=False) + "\n").encode())


def print_report(
    report: dict[str, Any], json: bool, out: Sequence[str | Path] | None = None, full: bool = True, **_: Any
) -> int:
    """Print a summary or, with `full`, the tables of a report; or the report as JSON."""
    if json:
        print_json(report)
        return 0
    from datagen.evaluation.report_page import print_evaluation

    print_evaluation(report, full)
    if out:
        print_rows("written", [("", str(file)) for file in out])
    return 0
