"""Camera of a trial: the view that shows most of target, hand and arm, without walls in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64, Mesh, concatenate
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses.house import House, StaticBody
from datagen.workers.rendering import Camera
from datagen.workers.rendering.embree import RayMesh, RayScene, cast_pixels, occluded, ray_mesh

_AZIMUTHS, _ELEVATIONS_DEG = 20, (20.0, 42.0)
_PROBE_PX = 56  # width of the images that compare views
_MARGIN = 0.86  # share of half an image that the visible points may fill
_WALL_M = 0.5  # lower walls (and floors, which loaders return as walls) hide nothing
_SIDEWAYS = 0.25  # weight of a view across the arm, compared with one along it

Rows = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera, and the house without the walls in front of it."""

    camera: Camera
    house: RayMesh


@dataclass(frozen=True, eq=False)
class Subject:
    """Criteria for a view.

    `moments` are stages without a house; `focus` groups rows of their bodies, and a group counts with its
    weight times its visible share. `points_m` (N, 3) must lie in the image. `forward` (3,) is the direction
    that the view should cross.
    """

    moments: Sequence[RayScene]
    focus: Sequence[tuple[Rows, float]]
    points_m: F64
    forward: F64


@lru_cache(maxsize=1)
def nothing() -> RayMesh:
    """A ray mesh that no ray hits: a speck far below the ground."""
    speck = np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]], np.float32) - np.float32(1e4)
    return ray_mesh(Mesh(speck, np.array([[0, 1, 2]], np.int32), np.zeros((1, 3), np.uint8)))


def choose_shot(house: House, subject: Subject, distance_m: float, width_px: int, height_px: int) -> Shot:
    """The best of the views all around, `distance_m` from the centre of the points."""
    walls = [body for body in house.bodies if _is_wall(body)]
    open_house = _rays_without(house, walls)
    middle_m = (subject.points_m.min(0) + subject.points_m.max(0)) / 2
    best, best_score = None, -1.0
    for elevation in np.radians(_ELEVATIONS_DEG):
        for azimuth in 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS:
            flat = np.cos(elevation)
            away = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
            eye_m = middle_m + distance_m * away
            camera = _framed(eye_m, middle_m, subject.points_m, width_px, height_px)
            probe = _resized(camera, _PROBE_PX)
            across = float(np.linalg.norm(np.cross(away, subject.forward)))
            score = _share_seen(open_house, subject, probe) + _SIDEWAYS * across
            if score > best_score:
                best, best_score = camera, score
    assert best is not None
    blocking = _blocking(walls, best, subject.points_m, distance_m)
    return Shot(best, _rays_without(house, blocking))


def scaled_camera(camera: Camera, factor: int) -> Camera:
    """The same view with `factor` times the pixels per side."""
    return _resized(camera, camera.width_px * factor)


def _resized(camera: Camera, width_px: int) -> Camera:
    s = width_px / camera.width_px
    height_px = round(camera.height_px * s)
    return Camera(
        camera.T_world_camera, width_px, height_px, camera.fx_px * s, camera.fy_px * s,
        camera.cx_px * s, camera.cy_px * s,
    )  # fmt: skip


def _framed(eye_m: F64, middle_m: F64, points_m: F64, width_px: int, height_px: int) -> Camera:
    """A camera whose focal length fits all points into the image."""
    T = look_at(eye_m, middle_m)
    local = (points_m - T[:3, 3]) @ T[:3, :3]
    spread = np.abs(local[:, :2] / np.maximum(local[:, 2:], 0.1)).max(0)
    half = _MARGIN * np.array([width_px, height_px]) / 2
    focal_px = float((half / np.maximum(spread, 1e-6)).min())
    return Camera(T, width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2)


def _share_seen(house: RayMesh, subject: Subject, probe: Camera) -> float:
    """Weighted visible share of the focus groups, mean over the moments."""
    pixels = np.arange(probe.width_px * probe.height_px)
    total = 0.0
    for moment in subject.moments:
        full = RayScene(house, moment.objects, moment.radii_m, moment.T_world_object)
        body = cast_pixels(full, probe, pixels).body - 1
        for rows, weight in subject.focus:
            alone = cast_pixels(_only(moment, rows), probe, pixels).body > 0
            if alone.any():
                total += weight * float(np.isin(body[alone], rows).mean())
    return total / len(subject.moments)


def _only(stage: RayScene, rows: Rows) -> RayScene:
    keep = list(rows)
    return RayScene(
        stage.house, [stage.objects[k] for k in keep], stage.radii_m[keep], stage.T_world_object[keep]
    )


def _is_wall(body: StaticBody) -> bool:
    return body.kind == "wall" and max(float(p[:, 2].max()) for p in body.convex_parts_m) > _WALL_M


def _blocking(
    walls: Sequence[StaticBody], camera: Camera, points_m: F64, distance_m: float
) -> list[StaticBody]:
    """Walls in front of the points, or of the centre of the view."""
    T = camera.T_world_camera
    half = np.array([camera.width_px / camera.fx_px, camera.height_px / camera.fy_px]) / 2
    u, v = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.9, 0.9, 7)] * 2))
    ground = 0.85 * distance_m * np.stack([u * half[0], v * half[1], np.ones(len(u))], axis=1)
    ends_m = np.concatenate([points_m, ground @ T[:3, :3].T + T[:3, 3]])
    origins = np.tile(T[:3, 3].astype(np.float32), (len(ends_m), 1))
    directions = (ends_m - T[:3, 3]).astype(np.float32)
    limits = np.ones(len(ends_m), np.float32)

    def before(wall: StaticBody) -> npt.NDArray[np.bool_]:
        return occluded(ray_mesh(wall.visual), origins, directions, limits)

    return [wall for wall in walls if before(wall).any()]


def _rays_without(house: House, left_out: Sequence[StaticBody]) -> RayMesh:
    names = {body.body_id for body in left_out}
    kept = [body.visual for body in house.bodies if body.body_id not in names]
    return ray_mesh(concatenate(kept)) if kept else nothing()
