"""Options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from datagen.schemas.errors import InputError

_MOST_RESAMPLES = 10_000

RunPlace = Annotated[str, Parameter(name="RUN", help="Folder or s3:// address of a run or of merged runs.")]
AllowIncomplete = Annotated[
    bool, Parameter(negative=(), help="Accept runs that lack planned samples instead of failing.")
]
AsJson = Annotated[bool, Parameter(negative=(), help="Print one JSON document to standard output.")]


def refuse_odd_draws(bootstrap: int, seed: int) -> None:
    """Raise InputError for a number of resamples or a seed that is out of range."""
    if not 1 <= bootstrap <= _MOST_RESAMPLES:
        fix = "Give another number; 1000 is usual"
        raise InputError("--bootstrap", str(bootstrap), f"is not between 1 and {_MOST_RESAMPLES}", fix)
    if seed < 0:
        raise InputError("--seed", str(seed), "is below 0", "Give 0 or more")


def refuse_output(file: Path, option: str, *endings: str) -> None:
    """Raise InputError for an output file with another suffix or in a folder that does not exist."""
    if file.suffix.lower() not in endings:
        valid = " or ".join(endings)
        raise InputError(file, option, f"is not a {valid} file", f"Give a name that ends in {valid}")
    if not file.parent.is_dir():
        raise InputError(file, option, "its folder does not exist", "Make the folder first")
