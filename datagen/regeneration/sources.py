"""Options for the sources of an existing run after they have moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter


@Parameter(name="*")
@dataclass(frozen=True)
class AssetSources:
    """References of houses and objects from the command line; None: those in the run's manifest."""

    houses: Annotated[str | None, Parameter(help="New location of the houses [as in the run].")] = None
    objects: Annotated[str | None, Parameter(help="New location of the objects [as in the run].")] = None


@Parameter(name="*")
@dataclass(frozen=True)
class Sources(AssetSources):
    """The same, and the run whose scenes a run labelled again."""

    scenes_from: Annotated[
        str | None, Parameter(help="New location of the run with the scenes [as in the run].")
    ] = None


AS_FOUND = Sources()
