"""Frames to look at and to learn from: a light that casts shadows, ceilings, and the sky through windows.

Geometry, and so depth and bodies, are those of `embree.py`; stored clouds keep the colours that it gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64, U8
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.house import Room
from datagen.workers.rendering import I16, Camera, Frame
from datagen.workers.rendering.cloud import target_pixels
from datagen.workers.rendering.embree import (
    Hits,
    RayMesh,
    RayScene,
    Values,
    cast_surfaces,
    into_frame,
    occluded,
    surface_colour,
)

I64 = npt.NDArray[np.int64]

_CEILING, _GROUND = np.array([[236, 234, 229], [128, 133, 112]], np.float32)
_HORIZON, _ZENITH = np.array([[222, 232, 241], [104, 158, 222]], np.float32)
# Shares of a surface's colour: by all surfaces, more by those that face up or one side, and by the light.
_AMBIENT, _FILL, _LIGHT = 0.58, (0.04, 0.06, 0.10), 0.50
_LIGHT_M = 2.2  # only things below this height cast shadows: walls are higher, and would darken whole rooms
_OFF_SURFACE_M = 1e-3
_IN_CACHE = 16_384  # pixels
_MARGIN = 1.3  # of the sphere around all objects, which a picture shows larger off its middle
# Range of the light's direction: degrees above the horizon, and to a side of straight behind the camera.
_ELEVATION_DEG, _ASIDE_DEG = (45.0, 75.0), (20.0, 70.0)


def draw_light(camera: Camera, rng: np.random.Generator) -> F32:
    """A unit vector (3,), world, towards a light above and behind the camera, to its left or right."""
    up, aside = np.radians([rng.uniform(*_ELEVATION_DEG), rng.choice([-1, 1]) * rng.uniform(*_ASIDE_DEG)])
    back = np.arctan2(*-camera.T_world_camera[[1, 0], 2])
    level = np.cos(up) * np.array([np.cos(back + aside), np.sin(back + aside)])
    return np.array([*level, np.sin(up)], np.float32)


def render_shaded(scene: RayScene, rooms: Sequence[Room], camera: Camera, to_light: F32) -> Frame:
    """The whole frame of a scene under parallel light from the direction `to_light` (3,), world.

    Rooms have ceilings at the top of the walls, which only colour the picture: they have no depth and no
    body, as little as the sky, and cast no shadow.
    """
    h, w = camera.height_px, camera.width_px
    center_m, radius_m = _objects_sphere(scene)
    near = np.zeros(h * w, np.bool_)
    near[target_pixels(camera, center_m, _MARGIN * radius_m)] = True
    rgb, depth_m = np.empty((h * w, 3), np.uint8), np.empty(h * w, np.float32)
    body, bare = np.empty(h * w, np.int16), replace(scene, objects=())
    for visible, pixels in (scene, np.flatnonzero(near)), (bare, np.flatnonzero(~near)):
        for k in range(0, len(pixels), _IN_CACHE):
            block = pixels[k : k + _IN_CACHE]
            surfaces = cast_surfaces(visible, camera, block, _surface, np.zeros(6, np.float32))
            rgb[block] = _lit(scene, rooms, camera, to_light, surfaces)
            depth_m[block], body[block] = surfaces[1:3]
    return Frame(camera, rgb.reshape(h, w, 3), depth_m.reshape(h, w), body.reshape(h, w))


def _lit(
    scene: RayScene,
    rooms: Sequence[Room],
    camera: Camera,
    to_light: F32,
    surfaces: tuple[Values, F32, I16, F32],
) -> U8:
    values, depth_m, body, rays = surfaces
    colour, normals = values[:, :3], values[:, 3:]
    faces_light, fill = (normals @ np.column_stack([to_light, np.array(_FILL, np.float32)])).T
    rows = np.flatnonzero(faces_light > 0)
    eye_m = camera.T_world_camera[:3, 3].astype(np.float32)
    points_m = eye_m + depth_m[rows, None] * rays[rows] + _OFF_SURFACE_M * normals[rows]
    rows = rows[~_in_shadow(scene, np.asarray(points_m, np.float32), to_light)]
    light = _AMBIENT + fill
    light[rows] += _LIGHT * faces_light[rows]
    rgb = np.minimum(colour * light[:, None], 255).astype(np.uint8)
    empty = np.flatnonzero(body < 0)
    rgb[empty] = _outside(eye_m, rays[empty], rooms, float(scene.house.mesh.vertices_m[:, 2].max()))
    return rgb


def _surface(rays: RayMesh, hits: Hits, directions: F32, R_world_mesh: F32 | None) -> F32:
    """Colours and unit normals of hits, (N, 6): normals in the world frame, towards the camera."""
    normals = rays.normals[hits.face]
    normals *= -np.sign(np.einsum("ij,ij->i", normals, directions))[:, None]
    if R_world_mesh is not None:
        normals = normals @ R_world_mesh.T
    return np.hstack([surface_colour(rays, hits), normals], dtype=np.float32)


def _in_shadow(scene: RayScene, points_m: F32, to_light: F32) -> npt.NDArray[np.bool_]:
    """Whether something lies between points (N, 3) and the light."""
    towards = np.tile(to_light, (len(points_m), 1))
    limits = np.maximum((_LIGHT_M - points_m[:, 2]) / to_light[2], 0)
    dark = occluded(scene.house, points_m, towards, limits)
    # Objects lie around the target: few points can be in the shadow of any.
    center_m, radius_m = _objects_sphere(scene)
    near = _below_sphere(points_m, to_light, center_m, radius_m)
    for rays, T, radius_m in zip(scene.objects, scene.T_world_object, scene.radii_m, strict=True):
        rows = near[_below_sphere(points_m[near], to_light, T[:3, 3], radius_m)]
        dark[rows] |= occluded(rays, *into_frame(T, points_m[rows], towards[rows]), limits[rows])
    return dark


def _objects_sphere(scene: RayScene) -> tuple[F64, float]:
    """Centre (3,), the target's, and radius (m) of a sphere that holds all objects, world."""
    centers_m = scene.T_world_object[:, :3, 3]
    return centers_m[0], float((np.linalg.norm(centers_m - centers_m[0], axis=1) + scene.radii_m).max())


def _below_sphere(points_m: F32, to_light: F32, centre_m: F64, radius_m: float) -> I64:
    """Rows of points (N, 3) whose ray to the light passes through the sphere."""
    rel = centre_m.astype(np.float32) - points_m
    along = rel @ to_light
    gap2 = np.einsum("ij,ij->i", rel, rel) - along**2
    return np.flatnonzero((gap2 < radius_m**2) & (along > -radius_m))


def _outside(eye_m: F32, rays: F32, rooms: Sequence[Room], ceiling_m: float) -> F32:
    """Colours (N, 3) along rays that hit nothing: the ceiling of a room, the sky, or the ground."""
    up = rays[:, 2] / np.linalg.norm(rays, axis=1)
    rgb = np.where(up[:, None] < 0, _GROUND, _HORIZON + up[:, None] * (_ZENITH - _HORIZON))
    rise = (ceiling_m - eye_m[2]) / np.where(up > 0, rays[:, 2], np.inf)
    xy = (eye_m + rise[:, None] * rays)[:, :2].astype(np.float64)
    for room in rooms:
        rgb[(up > 0) & inside_polygon(xy, room.polygon_m)] = _CEILING
    return rgb
