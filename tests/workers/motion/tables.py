"""Scenes on the table of `table_house`, and grasps of a box written by hand."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache

import numpy as np

from datagen.schemas.specification import MotionParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.grasps.grasp_cache import GraspSet
from datagen.workers.houses.house import House, StaticBody
from datagen.workers.motion import PlanReport
from datagen.workers.motion.planning_scene import PlanningScene, prepare
from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering import SceneGeometry
from datagen.workers.rendering.embree import ray_scene
from datagen.workers.robots import open_robot
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from datagen.workers.scenes.reconstruct import ReconstructedScene
from datagen.workers.world import PreparedHouse
from tests.workers.worlds import ROOM_M, TABLE_TOP_M, box_body, box_model, on_table, table_house

BOX_M = (0.05, 0.05, 0.12)
TARGET_XY_M = (0.0, -0.2)  # off the table's middle: 20 cm from its front edge
PEDESTAL_M = 0.2
PARAMS = MotionParams()


@cache
def arm(reach_m: float = 0.85, height_m: float = 0.75) -> Robot:
    return open_robot("panda-scaled", reach_m, height_m)


def box_grasps() -> GraspSet:
    """Of a box of `BOX_M`: from above with the fingers along both sides, and from four sides."""
    rows = [  # height of the TCP, approach, closing axis
        *((BOX_M[2] / 2 - deep, [0, 0, -1], y) for y in np.eye(3)[:2] for deep in (0.02, 0.035)),
        *((z, [c, s, 0], [-s, c, 0]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)) for z in (0.0, 0.03)),
    ]
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    for k, (height_m, approach, closing) in enumerate(rows):
        T[k, :3, :3] = np.column_stack([np.cross(closing, approach), closing, approach])
        T[k, 2, 3] = height_m
    scores = np.repeat(np.float32([1.0, 0.8]), [4, 8])
    return GraspSet(T, np.full(len(rows), 0.064, np.float32), scores)


def scene_of(house: House, objects: Sequence[ObjectModel], poses: Sequence[F64]) -> SettledScene:
    T = np.stack(poses)
    rays = ray_scene(SceneGeometry(house, tuple(objects), T))
    return ReconstructedScene(0, 0, PreparedHouse(house), tuple(objects), T, rays, camera=None)  # type: ignore[arg-type]


def table_scene(
    furniture: Sequence[StaticBody] = (),
    clutter: Sequence[tuple[ObjectModel, float, float]] = (),
) -> SettledScene:
    """The box on the table, with clutter at places (dx, dy) off the table's middle."""
    box = box_model("box", BOX_M)
    objects = [box, *(model for model, _, _ in clutter)]
    poses = [on_table(box, *TARGET_XY_M), *(on_table(m, dx, dy) for m, dx, dy in clutter)]
    return scene_of(table_house(furniture), objects, poses)


def over_target(
    body_id: str, size_m: tuple[float, float, float], low_m: float, shift_y_m: float = 0.0
) -> StaticBody:
    """A static board whose underside is `low_m` above the table, over the target."""
    x, y = ROOM_M[0] / 2 + TARGET_XY_M[0], ROOM_M[1] / 2 + TARGET_XY_M[1] + shift_y_m
    return box_body(body_id, "furniture", "Shelf", size_m, (x, y, TABLE_TOP_M + low_m + size_m[2] / 2))


def prepared(
    scene: SettledScene,
    robot: Robot | None = None,
    grasps: GraspSet | None = None,
    params: MotionParams = PARAMS,
    per_scene: int = 40,
    pedestal_m: float = PEDESTAL_M,
) -> PlanningScene:
    return prepare(scene, robot or arm(), grasps or box_grasps(), params, per_scene, pedestal_m)


def front_base(
    scene: SettledScene, robot: Robot | None = None, dx_m: float = 0.0, away_m: float = 0.5
) -> F64:
    """A base pose in front of the table, `away_m` from the target along y."""
    center = scene.target_center_m
    yaw_rad = float(np.arctan2(away_m, -dx_m))
    return yaw_pose(center[0] + dx_m, center[1] - away_m, (robot or arm()).base_height_m, yaw_rad)


def digest(report: PlanReport) -> str:
    """Of everything in a report."""
    content = hashlib.sha256(f"{report.outcome} {report.grasps_free} {report.grasps_tried}".encode())
    if report.plan is not None:
        for name in report.plan.__dataclass_fields__:
            content.update(np.asarray(getattr(report.plan, name)).tobytes())
    return content.hexdigest()
