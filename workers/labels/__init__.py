"""Labels of base poses. LABEL_SOURCES is the registry; each source lives in one file."""

from __future__ import annotations

from workers.labels.source import LabelSource
from workers.registry import entry

LABEL_SOURCES: dict[str, str] = {
    "heuristic": "workers.labels.distance_visibility:HEURISTIC",
    "plan": "workers.labels.plan:PLAN",
    "sim": "workers.labels.sim:SIM",
}


def load_label_source(name: str) -> LabelSource:
    """The label source of that name. Raises InputError where there is none."""
    source: LabelSource = entry(LABEL_SOURCES, name, "label source")
    return source
