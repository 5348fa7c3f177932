"""Labels of base poses. LABEL_SOURCES is the registry; each source lives in one file."""

from __future__ import annotations

from datagen.workers.labels.source import LabelSource
from datagen.workers.registry import entry

LABEL_SOURCES: dict[str, str] = {
    "heuristic": "datagen.workers.labels.heuristic_source:HEURISTIC",
    "plan": "datagen.workers.labels.plan_source:PLAN",
    "sim": "datagen.workers.labels.sim_source:SIM",
}


def load_label_source(name: str) -> LabelSource:
    """The label source of that name. Raises InputError where there is none."""
    source: LabelSource = entry(LABEL_SOURCES, name, "label source")
    return source
