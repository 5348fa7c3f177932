"""Versions of what can change bits of scenes and labels, on this machine and in a specification."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import different_fields
from datagen.schemas.specification import Specification
from datagen.workers.extras import missing_library
from datagen.workers.labels import load_label_source
from datagen.workers.scenes import scenes_version

# Distributions whose version can change bits of a sample, by the engine that needs them.
_ENGINE_PACKAGES = {"sapien": "sapien", "pybullet": "pybullet", "embree": "embreex"}
# Label sources that move an arm, and the distributions whose version can change bits of their labels.
ARM_PACKAGES: dict[str, tuple[str, ...]] = {
    "plan": ("coal", "mani_skill", "numba", "sapien"),
    "sim": ("coal", "mani_skill", "numba", "sapien"),
}


def scene_engine_names(spec: Specification) -> set[str]:
    """Names in `engines` of what can change bits of the scenes and candidates of this specification."""
    used = (spec.settle.engine, spec.observation.renderer)
    return {"scenes", *(_ENGINE_PACKAGES[name] for name in used)}


def label_engines(label_source: str) -> dict[str, str]:
    """Versions of what can change bits of labels, and of the random streams of scenes and labels."""
    return {
        _ENGINE_PACKAGES["embree"]: version(_ENGINE_PACKAGES["embree"]),
        # numpy may change what a generator draws between feature releases, never between patches.
        "numpy": ".".join(version("numpy").split(".")[:2]),
        "labels": str(load_label_source(label_source).version),
        **arm_versions(label_source),
    }


def scene_engines(spec: Specification) -> dict[str, str]:
    """Versions on this machine of what can change bits of the scenes and candidates."""
    packages = sorted(scene_engine_names(spec) - {"scenes"})
    return {name: version(name) for name in packages} | {"scenes": str(scenes_version(spec))}


def arm_versions(label_source: str) -> dict[str, str]:
    """Versions of the distributions that plan or simulate the arm of this label source."""
    return {name: version(name) for name in ARM_PACKAGES.get(label_source, ())}


def refuse_other_engines(place: str, spec: Specification) -> None:
    """Raise InputError for a specification of other versions of the label code or of engines than here."""
    try:
        here = label_engines(spec.label_source)
        if spec.scenes_from is None:  # stored scenes need no scene engines
            here |= scene_engines(spec)
    except PackageNotFoundError as error:
        missing = missing_library(error)
        fix = missing.fix if missing else "Install it"
        raise InputError(place, "engines", f"{error.name} is not installed", fix) from None
    made = {name: version for name, version in spec.engines.items() if name in here}
    rows = [f"{name}: the run has {a}, this machine {b}" for name, a, b in different_fields(made, here)]
    if rows:
        fix = "Install the run's versions, or start a new run"
        raise InputError(place, "engines", "; ".join(rows), fix)
