"""Labels of base poses. LABEL_SOURCES is the registry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import Specification
from datagen.workers.registry import entry

if TYPE_CHECKING:  # they load renderers, which a base installation lacks
    from datagen.workers.bases.candidates import SceneCandidates
    from datagen.workers.scenes import SettledScene

Columns = dict[str, np.ndarray[Any, Any]]


@dataclass(frozen=True)
class LabelSource:
    """A way to label the candidates of a scene.

    `label` returns, one row per candidate, the columns of the schema that depend on the scene: `label` and
    its explanation. `schema` names the record schema of its store, and `version` is raised when the same
    input may give another label.
    """

    name: str
    version: int
    schema: str
    label: Callable[[SettledScene, SceneCandidates, Specification, StageClock], Columns]


LABEL_SOURCES: dict[str, str] = {
    "heuristic": "datagen.workers.labels.heuristic_source:HEURISTIC",
    "plan": "datagen.workers.labels.arm_sources:PLAN",
    "sim": "datagen.workers.labels.arm_sources:SIM",
}


def load_label_source(name: str) -> LabelSource:
    """The label source of that name. Raises InputError where there is none."""
    source: LabelSource = entry(LABEL_SOURCES, name, "label source")
    return source
