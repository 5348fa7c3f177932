"""Where the sources of an existing run lie now, if they have moved: options of several verbs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter


@Parameter(name="*")
@dataclass(frozen=True)
class AssetSources:
    """References of houses and objects as the user gives them; None is where the run found them."""

    houses: Annotated[str | None, Parameter(help="Where the houses lie now [where the run found them].")] = (
        None
    )
    objects: Annotated[
        str | None, Parameter(help="Where the objects lie now [where the run found them].")
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class Sources(AssetSources):
    """The same, and the place whose scenes a run labelled again."""

    scenes_from: Annotated[
        str | None, Parameter(help="Where the run lies whose scenes are labelled again [where it was found].")
    ] = None


AS_FOUND = Sources()
