"""Files and printed tables of an evaluation, for the verbs that make one."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Any

from datagen.console.options import File, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.schemas.safe_files import whole_file


def output_file(out: File | None) -> Path | None:
    """The file of --out. InputError for another ending, or a folder that does not exist."""
    if out is None:
        return None
    refuse_output(Path(out), "--out", ".json")
    return Path(out)


def write_report(report: dict[str, Any], file: Path | None) -> None:
    """Write the report to the file, if one is given."""
    if file is not None:
        with whole_file(file, alone=True) as stream:
            stream.write((json_format.dumps(report, indent=1, allow_nan=False) + "\n").encode())


def print_report(
    report: dict[str, Any], json: bool, out: File | None = None, full: bool = True, **_: Any
) -> int:
    """Print a summary or, with `full`, the tables of a report; or the report as JSON."""
    if json:
        print_json(report)
        return 0
    from datagen.evaluation.printed_report import print_all, print_summary

    (print_all if full else print_summary)(report)
    if out is not None:
        print_rows("written", [("", str(out))])
    return 0
