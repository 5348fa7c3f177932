"""Sampling of the camera that observes a scene."""

from __future__ import annotations

import numpy as np

from datagen.schemas.specification import CandidateParams, ObservationParams
from datagen.workers.bases.clearance import Obstacles, base_clearance_m
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses.house import Room
from datagen.workers.rendering.frame import Camera
from datagen.workers.rendering.rays import RayScene
from datagen.workers.rendering.visibility import visible_pixels
from datagen.workers.scene_rejected import SceneRejected

_WINDOW_PX = 32  # rays per side to evaluate a viewpoint; coarser than for labels
_BLOCK = 8


def draw_viewpoint(
    rays: RayScene,
    room: Room,
    obstacles: Obstacles,
    target_center_m: F64,
    params: ObservationParams,
    robot: CandidateParams,
    rng: np.random.Generator,
) -> tuple[Camera, float]:
    """A camera at a free position in the room, and the share of the target that it sees.

    The carrier is a column of the robot's base radius up to the camera. Raises
    SceneRejected("no_viewpoint") if none of `max_viewpoints` positions is usable.
    """
    n = params.max_viewpoints
    angle = rng.uniform(-np.pi, np.pi, n)
    distance_m = rng.uniform(params.distance_m.low, params.distance_m.high, n)
    height_m = rng.uniform(params.camera_height_m.low, params.camera_height_m.high, n)
    xy = target_center_m[:2] + distance_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    column = height_m.astype(np.float32)
    radius_m = np.full(n, robot.base_radius_m)
    clearance_m = base_clearance_m(
        xy.astype(np.float32), column, column, radius_m, obstacles, robot.mast_radius_m
    )
    free = clearance_m >= 0
    usable = np.flatnonzero(free & inside_polygon(xy, room.polygon_m))
    eyes_m = np.column_stack([xy, height_m])
    for start in range(0, len(usable), _BLOCK):
        rows = usable[start : start + _BLOCK]
        alone, seen = visible_pixels(rays, 0, eyes_m[rows], _WINDOW_PX)
        share = seen / np.maximum(alone, 1)
        good = np.flatnonzero((share >= params.min_target_fraction) & (alone > 0))
        if len(good):
            row = rows[good[0]]
            return camera_at(eyes_m[row], target_center_m, params), float(share[good[0]])
    raise SceneRejected("no_viewpoint")


def camera_at(eye_m: F64, target_m: F64, params: ObservationParams) -> Camera:
    """The observation camera at `eye_m` (3,), turned to `target_m` (3,), principal point centred."""
    return Camera(
        T_world_camera=look_at(eye_m, target_m),
        width_px=params.width_px,
        height_px=params.height_px,
        fx_px=params.fx_px,
        fy_px=params.fy_px,
        cx_px=params.width_px / 2,
        cy_px=params.height_px / 2,
    )
