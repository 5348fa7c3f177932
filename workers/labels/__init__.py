"""Labels of base poses. LABEL_SOURCES is the registry; each source lives in one file."""

from __future__ import annotations

from workers.labels.distance_visibility import HEURISTIC
from workers.labels.source import LabelSource

LABEL_SOURCES: dict[str, LabelSource] = {
    HEURISTIC.name: HEURISTIC,
}
