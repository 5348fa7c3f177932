"""Summaries of a run's specification, for reports."""

from __future__ import annotations

from typing import Any

from datagen.schemas.specification import Specification


def is_disturbed(spec: Specification) -> bool:
    """Whether each candidate has several trials with random disturbances."""
    return spec.arm is not None and spec.arm.disturbance is not None


def specification_record(spec: Specification) -> dict[str, Any]:
    """The fields of a specification that reports show."""
    return {
        "spec_hash": spec.hash(),
        "label_source": spec.label_source,
        "disturbed": is_disturbed(spec),
        "split": spec.split,
        "seed": spec.seed,
        "candidates": spec.candidates.within or "grid",
        "per_scene": spec.candidates.count,
    }
