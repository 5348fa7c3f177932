"""A stored scene made whole again from its record: the same stage, without drawing or physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.errors import InputError
from workers.bases.candidates import Candidates
from workers.geometry.mesh import F64
from workers.objects.model import ObjectModel
from workers.rendering.frame import Camera, Stage
from workers.rendering.rays import RayStage
from workers.world import PreparedHouse, World

Record = Mapping[str, Any]  # one row of the scene table, or the samples' columns, by field name


@dataclass(frozen=True, eq=False)
class RecalledScene:
    """What a scene's record stands for: a `SettledScene`, with the camera it was observed by."""

    index: int
    retry: int
    house: PreparedHouse
    models: tuple[ObjectModel, ...]
    T_world_object: F64  # (K, 4, 4)
    rays: RayStage
    camera: Camera

    @property
    def target_center_m(self) -> F64:
        """World position (3,) of the target's frame: the centre of its bounding box."""
        return self.T_world_object[0, :3, 3]

    @property
    def stage(self) -> Stage:
        return Stage(self.house.house, self.models, self.T_world_object)


def recall_scene(world: World, record: Record) -> RecalledScene:
    """Rebuild the stage of a record from the sources it names.

    Raises InputError where a house or an object is not there any more or has other content.
    """
    house = world.house(str(record["house_id"]))
    _same(house.house.house_id, house.house.digest, str(record["house_digest"]))
    names = [str(name) for name in record["object_name"]]
    models = tuple(world.object(name).model for name in names)
    for model, digest in zip(models, record["object_digest"], strict=True):
        _same(model.name, model.digest, str(digest))
    T_world_object = np.asarray(record["T_world_object"], np.float64)
    fx, fy, cx, cy = (float(v) for v in record["intrinsics_px"])
    width, height = (int(v) for v in record["image_size_px"])
    camera = Camera(np.asarray(record["T_world_camera"], np.float64), width, height, fx, fy, cx, cy)
    rays = world.stage(house, names, T_world_object)
    index, retry = int(record["scene_index"]), int(record["retry"])
    return RecalledScene(index, retry, house, models, T_world_object, rays, camera)


def recall_candidates(columns: Record) -> Candidates:
    """The candidates of a scene from their stored columns, by field name."""
    return Candidates(
        base_xy_m=columns["base_xy_m"],
        robot_index=columns["robot_index"],
        camera_height_m=columns["camera_height_m"],
        base_height_m=columns["base_height_m"],
        arm_reach_m=columns["arm_reach_m"],
        clearance_m=columns["base_clearance_m"],
    )


def _same(name: str, found: str, stored: str) -> None:
    if found != stored:
        raise InputError(
            name,
            "digest",
            f"its content is {found[:12]}, but the scene was made with {stored[:12]}",
            "Give the houses and objects that the run was made with",
        )
