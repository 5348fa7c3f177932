"""Options that many verbs have, each worded once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from datagen.schemas.errors import InputError

_MOST_RESAMPLES = 10_000

RunPlace = Annotated[str, Parameter(help="The run's folder or s3:// address; also of merged runs.")]
AllowIncomplete = Annotated[
    bool, Parameter(negative=(), help="Read runs that lack samples of their plan, too, instead of failing.")
]
AsJson = Annotated[bool, Parameter(negative=(), help="Print one JSON document.")]


def refuse_odd_draws(bootstrap: int, seed: int) -> None:
    """InputError for a number of resamples, or a seed, that cannot be used."""
    if not 1 <= bootstrap <= _MOST_RESAMPLES:
        mend = f"Give 1 to {_MOST_RESAMPLES}; 1000 is usual"
        raise InputError("--bootstrap", str(bootstrap), "not a usable number of resamples", mend)
    if seed < 0:
        raise InputError("--seed", str(seed), "below 0", "Give 0 or more")


def refuse_output(file: Path, option: str, *endings: str) -> None:
    """InputError for a file to be written that has another ending, or whose folder is not there."""
    if file.suffix.lower() not in endings:
        valid = " or ".join(endings)
        raise InputError(file, option, f"is not a {valid} file", f"Give a name that ends in {valid}")
    if not file.parent.is_dir():
        raise InputError(file, option, "its folder does not exist", "Make the folder first")
