"""Versions of labels: the meaning of `label` may change between them."""

from __future__ import annotations

from collections.abc import Sequence

from datagen.schemas.errors import InputError
from datagen.schemas.specification import Specification


def refuse_mixed_labels(parts: Sequence[tuple[str, Specification]]) -> None:
    """Raise InputError where runs, (path, specification), have labels of one source in two versions."""
    seen: dict[str, tuple[str, str]] = {}
    for place, spec in parts:
        version = spec.engines.get("labels", "unknown")
        first, at = seen.setdefault(spec.label_source, (version, place))
        if first != version:
            problem = f"{spec.label_source} labels are of version {version}, those of {at} of version {first}"
            fix = "Use runs of one version, or give --allow-mixed-labels"
            raise InputError(place, "label_version", problem, fix)
