"""Rebuild a stored scene from its record: the same geometry, without sampling or physics.

The store checks bytes; this module checks values, so that no label is computed for impossible poses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import is_pose
from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering import Camera, SceneGeometry
from datagen.workers.rendering.embree import RayScene, ray_scene
from datagen.workers.world import PreparedHouse, World

Record = Mapping[str, Any]  # one row of the scene table, or the samples' columns, by field name

_PLACE = "stored scenes"
_FIX = "Make the run with these scenes again"
# Tolerance for rotations, which engines give as float32.
_ROUNDING = 1e-5
_TURN_RAD = 3.1416  # a little more than half a turn
_EXTENT_M = 1000.0  # no house is larger
# Bases farther from the target's centre are of no use, and their distance exceeds the schema's range.
_NEAR_M = 10.0


@dataclass(frozen=True, eq=False)
class ReconstructedScene:
    """A `SettledScene` from a scene's record, with its observation camera."""

    index: int
    retry: int
    house: PreparedHouse
    models: tuple[ObjectModel, ...]
    T_world_object: F64  # (K, 4, 4)
    rays: RayScene
    camera: Camera

    @property
    def target_center_m(self) -> F64:
        """World position (3,) of the target's frame: the centre of its bounding box."""
        return self.T_world_object[0, :3, 3]

    @property
    def geometry(self) -> SceneGeometry:
        return SceneGeometry(self.house.house, self.models, self.T_world_object)


def reconstruct_scene(world: World, record: Record) -> ReconstructedScene:
    """Rebuild the geometry of a record from the sources it names.

    Raises InputError if a house or an object is missing or has other content, and for impossible
    poses.
    """
    index, retry = int(record["scene_index"]), int(record["retry"])
    T_world_object = np.asarray(record["T_world_object"], np.float64)
    T_world_camera = np.asarray(record["T_world_camera"], np.float64)
    fx, fy, cx, cy = (float(v) for v in record["intrinsics_px"])
    width, height = (int(v) for v in record["image_size_px"])
    centre_m = np.asarray(record["target_center_m"], np.float64)
    for name, is_valid in (
        ("scene_index", index >= 0),
        ("retry", retry >= 0),
        ("T_world_object", all(map(_is_placed, T_world_object))),
        ("T_world_camera", _is_placed(T_world_camera)),
        ("intrinsics_px", bool(np.isfinite([cx, cy]).all()) and 0 < fx < 1e6 and 0 < fy < 1e6),
        ("image_size_px", 0 < width <= 4096 and 0 < height <= 4096),
        ("target_center_m", np.allclose(centre_m, T_world_object[0, :3, 3], rtol=0, atol=_ROUNDING)),
    ):
        if not is_valid:
            raise _impossible(index, name)
    house = world.house(str(record["house_id"]))
    _check_digest(house.house.house_id, house.house.digest, str(record["house_digest"]))
    names = [str(name) for name in record["object_name"]]
    while len(names) > 1 and not names[-1]:  # rows of scenes with fewer objects end with empty names
        names.pop()
    T_world_object = T_world_object[: len(names)]
    models = tuple(world.object(name) for name in names)
    for model, digest in zip(models, record["object_digest"], strict=False):
        _check_digest(model.name, model.digest, str(digest))
    camera = Camera(T_world_camera, width, height, fx, fy, cx, cy)
    rays = ray_scene(SceneGeometry(house.house, models, T_world_object))
    return ReconstructedScene(index, retry, house, models, T_world_object, rays, camera)


def reconstruct_candidates(columns: Record, scene: ReconstructedScene) -> SceneCandidates:
    """The candidates of a scene from their stored columns, by field name.

    Raises InputError for numbers that are not finite or out of the range of robots.
    """
    apart_m = np.hypot(*(columns["base_xy_m"] - scene.target_center_m[:2]).T)
    for name, is_valid in (
        ("base_xy_m", apart_m < _NEAR_M),
        ("base_yaw_rad", _within(columns["base_yaw_rad"], -_TURN_RAD, _TURN_RAD)),
        ("candidate_index", columns["candidate_index"] >= 0),
        ("robot_index", columns["robot_index"] >= 0),
        ("camera_height_m", _within(columns["camera_height_m"], 0.0, _NEAR_M)),
        ("base_height_m", _within(columns["base_height_m"], 0.0, _NEAR_M)),
        ("arm_reach_m", _within(columns["arm_reach_m"], 0.0, _NEAR_M)),
        ("base_clearance_m", _within(columns["base_clearance_m"], -_NEAR_M, _NEAR_M)),
    ):
        if not is_valid.all():
            raise _impossible(scene.index, name)
    return SceneCandidates(
        base_xy_m=columns["base_xy_m"],
        base_yaw_rad=columns["base_yaw_rad"],
        robot_index=columns["robot_index"],
        camera_height_m=columns["camera_height_m"],
        base_height_m=columns["base_height_m"],
        arm_reach_m=columns["arm_reach_m"],
        clearance_m=columns["base_clearance_m"],
        index=columns["candidate_index"],
    )


def _is_placed(T: F64) -> bool:
    """Whether a matrix (4, 4) is a rigid transform to a position within the size of a house."""
    return is_pose(T, _ROUNDING) and bool(np.abs(T[:3, 3]).max() <= _EXTENT_M)


def _within(values: np.ndarray[Any, Any], low: float, high: float) -> np.ndarray[Any, Any]:
    return (values >= low) & (values <= high)  # False for NaN


def _impossible(index: int, name: str) -> InputError:
    return InputError(_PLACE, f"scene {index}, {name}", "has impossible values", _FIX)


def _check_digest(name: str, found: str, stored: str) -> None:
    if found != stored:
        raise InputError(
            name,
            "digest",
            f"its content is {found[:12]}, but the scene was made with {stored[:12]}",
            "Give the houses and objects that the run was made with",
        )
