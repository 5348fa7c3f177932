"""Attributes of a store by the conventions CF and ACDD: title, source, licences, history.

All of them follow from specifications, so that a store of one specification has the same bytes everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from datagen.schemas.fields import Field, Table
from datagen.schemas.specification import Specification

CONVENTIONS = "CF-1.11, ACDD-1.3"


class _Asset(NamedTuple):
    name: str
    licence: str
    reference: str


_OURS = "datagen, which comes with it"
_HOUSES = {
    "builtin": _Asset("built-in houses", "Apache-2.0", _OURS),
    "procthor": _Asset(
        "ProcTHOR houses",
        "Apache-2.0",
        "Deitke et al., ProcTHOR: Large-Scale Embodied AI Using Procedural Generation, arXiv:2206.06994",
    ),
    "ai2thor": _Asset(
        "AI2-THOR scenes",
        "Apache-2.0",
        "Kolve et al., AI2-THOR: An Interactive 3D Environment for Visual AI, 2017, arXiv:1712.05474",
    ),
}
_OBJECTS = {
    "builtin": _Asset("built-in objects", "Apache-2.0", _OURS),
    "ycb": _Asset(
        "YCB objects",
        "CC-BY-4.0",
        "Calli et al., Benchmarking in Manipulation Research: Using the Yale-CMU-Berkeley Object and Model "
        "Set, 2015, doi:10.1109/MRA.2015.2448951",
    ),
}
# As the package states for its assets, which include the robots.
_ROBOTS = _Asset(
    "ManiSkill robot models",
    "CC-BY-NC-4.0",
    "Tao et al., ManiSkill3: GPU Parallelized Robotics Simulation and Rendering for Generalizable Embodied "
    "AI, 2024, arXiv:2410.00425",
)
_COMMENT = (
    "Arrays of dimension scene and arrays of dimension sample (a candidate base pose) are two tables, joined "
    "by scene_index and sample_scene_index. A data frame over both dimensions would hold their product: "
    "use datagen.candidates(path), which joins them."
)


def described(specs: Sequence[Specification], samples: Sequence[int] = ()) -> dict[str, Any]:
    """The global attributes of a store over runs of these specifications, with `samples` each."""
    assets = list(dict.fromkeys(asset for spec in specs for asset in _assets(spec)))
    labels = _listed(spec.label_source for spec in specs)
    houses, objects = (_listed(_assets(spec)[k].name for spec in specs) for k in (0, 1))
    return {
        "Conventions": CONVENTIONS,
        "title": f"Robot base poses labelled by {labels}, in {houses} with {objects}",
        "summary": (
            "Candidate base poses of a mobile manipulator around a target object on a support surface, each "
            "with a label that says whether the robot can work from there, and the RGB-D point cloud of "
            "each scene."
        ),
        "source": "; ".join(dict.fromkeys(map(_source, specs))),
        "license": "; ".join(f"{asset.name}: {asset.licence}" for asset in assets),
        "acknowledgement": "; ".join(f"{asset.name}: {asset.reference}" for asset in assets),
        "references": "; ".join(dict.fromkeys(asset.reference for asset in assets)),
        "history": "\n".join(
            f"datagen submit {spec.label_source}{n}, seed {spec.seed}, split {spec.split}, "
            f"specification {spec.hash()}"
            for spec, n in zip(specs, [f" --n {n}" for n in samples] or [""] * len(specs), strict=True)
        ),
        "comment": _COMMENT,
    }


def cf_attributes(field: Field, table: Table) -> dict[str, Any]:
    """CF attributes of an array in a sealed store; arrays of shards do not have them."""
    keys = ("scene_index", "house_id")
    if table == "sample":
        keys = ("sample_scene_index", "candidate_index", "robot_index")
    coordinates = {} if field.name in keys else {"coordinates": " ".join(keys)}
    return coordinates | ({"flag_values": list(range(len(field.codes)))} if field.codes else {})


def _assets(spec: Specification) -> list[_Asset]:
    """Houses, objects and, for an arm, robots."""
    found: list[_Asset] = []
    for known, source, what in ((_HOUSES, spec.houses, "houses"), (_OBJECTS, spec.objects, "objects")):
        other = _Asset(f"{source.kind} {what}", "as their source states", f"source {source.kind}")
        found.append(known.get(source.kind, other))
    return found if spec.arm is None else [*found, _ROBOTS]


def _source(spec: Specification) -> str:
    parts = [f"houses {spec.houses.kind} sha256 {spec.houses.digest}"]
    parts.append(f"objects {spec.objects.kind} sha256 {spec.objects.digest}")
    if spec.arm is not None:
        parts.append(f"robot {spec.arm.robot}")
    return ", ".join(parts + [f"{name} {version}" for name, version in sorted(spec.engines.items())])


def _listed(names: Any) -> str:
    return " and ".join(dict.fromkeys(names))
