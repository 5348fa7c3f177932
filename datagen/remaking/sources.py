"""Where the sources of an existing run lie now, if they have moved: three options, and what they say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

HousesAgain = Annotated[
    str | None, Parameter(help="Where the houses lie now [where the run found them].", name="--houses")
]
ObjectsAgain = Annotated[
    str | None, Parameter(help="Where the objects lie now [where the run found them].", name="--objects")
]
ScenesFromAgain = Annotated[
    str | None,
    Parameter(
        help="Where the run lies whose scenes are labelled again [where it was found].", name="--scenes-from"
    ),
]


@dataclass(frozen=True)
class Sources:
    """Source references and a place as the user gives them; None is where the run found them."""

    houses: str | None = None
    objects: str | None = None
    scenes_from: str | None = None


AS_FOUND = Sources()
