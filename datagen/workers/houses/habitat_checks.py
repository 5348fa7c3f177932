"""Checks of a habitat scene: units, axes, the order of rotations, the height of the floor."""

from __future__ import annotations

from collections import Counter

import numpy as np

from datagen.schemas.errors import choices
from datagen.workers.geometry.mesh import F64, Mesh
from datagen.workers.houses.mesh_geometry import normals_and_areas
from datagen.workers.json_document import JsonNode

_LARGEST_OBJECT_M, _LARGEST_STAGE_M, _SMALLEST_STAGE_M = 20.0, 300.0, 1.0
_FLOOR_M = 0.05
_HIGHEST_FLOOR_M = 1.0  # higher level faces of a stage are no floor
_METRES = "Scale the mesh to metres."
_ORIGINS = ("asset_local", "COM")


def is_about_centre(entry: JsonNode, scene: JsonNode) -> bool:
    """Whether an instance's translation places its centre of mass, not its mesh's origin.

    `translation_origin` of the instance counts before that of the scene; the default is the origin. Raises
    InputError for another value.
    """
    for node in (entry.find("translation_origin"), scene.find("translation_origin")):
        if node is not None and node.text().lower() != "unknown":
            if node.text().lower() not in map(str.lower, _ORIGINS):
                raise node.error(f"unknown origin {node.text()!r}", choices(_ORIGINS, node.text()))
            return node.text().lower() == "com"
    return False


def refuse_upside_down(scene: JsonNode, poses: list[F64], findings: Counter[str]) -> None:
    """Count objects that stand on their heads; InputError if most do: rotations of another order do so."""
    count = sum(T[2, 2] < -0.5 * np.linalg.norm(T[:3, 2]) for T in poses)
    if count > len(poses) / 2:
        problem = f"implausible: {count} of {len(poses)} objects stand upside down"
        raise scene.get("object_instances").error(problem, "Write rotations as w, x, y, z.")
    if count:
        findings["implausible (upside down)"] = int(count)


def refuse_unfit_size(entry: JsonNode, mesh: Mesh) -> None:
    """Raise InputError for a placed object larger than any piece of furniture."""
    span_m = float(np.ptp(mesh.vertices_m, axis=0).max())
    if span_m > _LARGEST_OBJECT_M:
        raise entry.get("template_name").error(f"wrong unit: the object spans {span_m:.4g} m", _METRES)


def refuse_unfit_stage(entry: JsonNode, stage: Mesh) -> None:
    """Raise InputError for a stage (world frame, without its ceiling) that no robot can stand in."""
    if not len(stage.faces):
        raise entry.error("has neither walls nor floor", "Download the scenes again.")
    span_m = float(np.ptp(stage.vertices_m, axis=0)[:2].max())
    if not _SMALLEST_STAGE_M <= span_m <= _LARGEST_STAGE_M:
        raise entry.error(f"wrong unit: the stage spans {span_m:.4g} m", _METRES)
    normals, areas = normals_and_areas(stage)
    height_m = stage.vertices_m[stage.faces][:, :, 2].mean(axis=1)
    is_level = (normals[:, 2] > 0.97) & (height_m < _HIGHEST_FLOOR_M)
    at_zero = is_level & (np.abs(height_m) < _FLOOR_M)
    others, level = np.unique(np.round(height_m[is_level & ~at_zero], 1), return_inverse=True)
    if not len(others):
        return
    sums_m2 = np.bincount(level, areas[is_level & ~at_zero])
    if sums_m2.max() > areas[at_zero].sum():
        problem = f"another floor: most of it lies at {others[sums_m2.argmax()]:g} m, not at 0"
        raise entry.error(problem, "Move the stage and its objects so that the floor lies at 0.")
