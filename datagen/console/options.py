"""Options that several verbs share.

The help of an option is its line in the `Args:` section of the verb's docstring, or is given here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Group, Parameter, Token

from datagen.schemas.errors import InputError

_NUMBER = re.compile(r"[+-]?([0-9]{1,30}|[0-9]{1,3}(,[0-9]{3}){1,9})((\.[0-9]{1,30})?[eE]\+?[0-9]{1,2})?")


def _whole_number(kind: Any, tokens: Sequence[Token]) -> int:
    text = tokens[0].value
    value = Decimal(text.replace(",", "")) if _NUMBER.fullmatch(text) else None
    if value is None or value != int(value):
        shown = text if len(text) <= 40 else text[:37] + "..."
        raise ValueError(f'"{shown}" is not a whole number like 600, 180,000 or 1e5.')
    return int(value)


# Headings in the help of verbs that make labels.
LABELLED = Group.create_ordered("What is labelled")
ROBOT = Group.create_ordered("Which robot")
RUNNING = Group.create_ordered("How it runs")


def option(text: str, group: Group) -> Parameter:
    """An option with its help, under a heading."""
    return Parameter(help=text, group=group)


# 180000, 180,000 or 1e5. A plain int would read 2.5 as 2.
Whole = Annotated[int, Parameter(converter=_whole_number)]
RUN = Parameter(name="RUN", help="Folder or s3:// address of a run or of merged runs.")
RunPath = Annotated[str, RUN]
# The command line gives text. An address such as s3://bucket/run is not a `Path`.
PathOrAddress = Annotated[str | Path, Parameter(metavar="STR")]
PathsOrAddresses = Annotated[Sequence[str | Path], Parameter(metavar="STR...")]
File = Annotated[str | Path, Parameter(metavar="PATH")]
AllowIncomplete = Annotated[bool, Parameter(help="Accept runs that lack planned samples instead of failing.")]
JSON_HELP = "Print one JSON document to standard output, and progress as JSON lines to standard error."
AsJson = Annotated[bool, Parameter(help=JSON_HELP)]


def refuse_output(file: Path, option: str, *endings: str) -> None:
    """Raise InputError for an output file with another suffix or in a folder that does not exist."""
    if file.suffix.lower() not in endings:
        valid = " or ".join(endings)
        raise InputError(file, option, f"is not a {valid} file", f"Give a name that ends in {valid}")
    if str(file).startswith(("s3:/", "gs:/")):
        raise InputError(file, option, "is an address", "Name a file on this machine, and copy it afterwards")
    if not file.parent.is_dir():
        raise InputError(file, option, "its folder does not exist", "Make the folder first")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class AssetSources:
    """References of houses, objects and a robot's file; None: those in the run's manifest."""

    houses: Annotated[str | None, Parameter(help="New location of the houses.")] = None
    objects: Annotated[str | None, Parameter(help="New location of the objects.")] = None
    robot: Annotated[str | None, Parameter(help="New location of the robot's file.")] = None


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Sources(AssetSources):
    """References of houses, objects and the run whose scenes a run labelled again."""

    scenes_from: Annotated[str | None, Parameter(help="New location of the run with the scenes.")] = None


AS_FOUND = Sources()
