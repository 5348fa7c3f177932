"""What a specification says of the labels that it makes, as reports hold it."""

from __future__ import annotations

from typing import Any

from datagen.schemas.specification import Specification


def is_disturbed(spec: Specification) -> bool:
    """Whether each trial is run from several disturbed arrivals."""
    return spec.arm is not None and spec.arm.disturbance is not None


def specification_record(spec: Specification) -> dict[str, Any]:
    """Which labels these are, of which houses and candidates."""
    return {
        "spec_hash": spec.hash(),
        "label_source": spec.label_source,
        "disturbed": is_disturbed(spec),
        "split": spec.split,
        "seed": spec.seed,
        "candidates": spec.candidates.within or "grid",
        "per_scene": spec.candidates.count,
    }
