"""What a label source takes and gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.cost import StageClock
from schemas.specification import Specification
from workers.bases.candidates import Candidates
from workers.scenes.scene import SettledScene

Columns = dict[str, np.ndarray[Any, Any]]


@dataclass(frozen=True)
class LabelSource:
    """A way to label the candidates of a scene.

    `label` returns, one row a candidate, the columns of the schema that the candidate alone does
    not decide: `label` and whatever explains it. `schema` names the record schema of its store,
    and `version` rises whenever the same input may give another label.
    """

    name: str
    version: int
    schema: str
    label: Callable[[SettledScene, Candidates, Specification, StageClock], Columns]
