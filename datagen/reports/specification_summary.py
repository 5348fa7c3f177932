"""Summaries of a run's specification and sources, for reports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from datagen.schemas.run_records import Manifest
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


def made_from(manifests: Iterable[Manifest]) -> str:
    """Houses, objects and robot of some runs: "400 builtin houses (split all), 10 builtin objects, ..."."""
    lines: dict[str, None] = {}
    for spec, known in ((manifest.spec, manifest.sources) for manifest in manifests):
        # Runs of older versions do not record the numbers.
        houses = f"{known.get('n_houses', '')} {spec.houses.kind} houses (split {spec.split})"
        objects = f"{known.get('n_objects', '')} {spec.objects.kind} objects"
        robot = f"robot {spec.arm.robot}" if spec.arm else "sampled robots"
        lines[", ".join(part.strip() for part in (houses, objects, robot))] = None
    return "; ".join(lines)
