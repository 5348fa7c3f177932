"""Frames to look at and to learn from: cast shadows, patterns and textures, ceilings, sky through windows.

Geometry, and so depth and bodies, are those of `embree.py`; stored clouds keep the colours that it gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64, I32
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.house import House, Room
from datagen.workers.rendering import Camera, Frame
from datagen.workers.rendering.cloud import target_pixels
from datagen.workers.rendering.covers import house_cover
from datagen.workers.rendering.embree import (
    Hits,
    RayMesh,
    RayScene,
    cast_surfaces,
    into_frame,
    occluded,
    surface_colour,
)

I16, I64 = npt.NDArray[np.int16], npt.NDArray[np.int64]

_CEILING, _GROUND = np.array([[236, 234, 229], [128, 133, 112]], np.float32)
_HORIZON, _ZENITH = np.array([[222, 232, 241], [104, 158, 222]], np.float32)
# Shares of a surface's colour: by all surfaces, more by those that face up or one side, and by the light.
_AMBIENT, _FILL, _LIGHT = 0.58, (0.04, 0.06, 0.10), 0.50
_LIGHT_M = 2.2  # only things below this height cast shadows: walls are higher, and would darken whole rooms
_OFF_SURFACE_M = 1e-3
_IN_CACHE = 49_152  # pixels
_MARGIN = 1.3  # of the sphere around all objects, which a picture shows larger off its middle
# Range of the light's direction: degrees above the horizon, and to a side of straight behind the camera.
_ELEVATION_DEG, _ASIDE_DEG = (45.0, 75.0), (20.0, 70.0)


def draw_light(camera: Camera, rng: np.random.Generator) -> F32:
    """A unit vector (3,), world, towards a light above and behind the camera, to its left or right."""
    up, aside = np.radians([rng.uniform(*_ELEVATION_DEG), rng.choice([-1, 1]) * rng.uniform(*_ASIDE_DEG)])
    back = np.arctan2(*-camera.T_world_camera[[1, 0], 2])
    level = np.cos(up) * np.array([np.cos(back + aside), np.sin(back + aside)])
    return np.array([*level, np.sin(up)], np.float32)


def render_shaded(scene: RayScene, house: House, camera: Camera, to_light: F32) -> Frame:
    """The whole frame of a scene in `house` under parallel light from the direction `to_light` (3,), world.

    Rooms have ceilings at the top of the walls, which only colour the picture: they have no depth and no
    body, as little as the sky, and cast no shadow.
    """
    return _Lighting(scene, house, camera, to_light).frame()


class _Lighting:
    """A scene under light, with what is the same for all pixels."""

    def __init__(self, scene: RayScene, house: House, camera: Camera, to_light: F32) -> None:
        self.scene, self.rooms, self.camera, self.to_light = scene, house.rooms, camera, to_light
        self.cover, self.ceiling_m = house_cover(house), float(scene.house.mesh.vertices_m[:, 2].max())
        self.eye_m = camera.T_world_camera[:3, 3].astype(np.float32)
        centers_m = scene.T_world_object[:, :3, 3]
        gaps_m = np.linalg.norm(centers_m - centers_m[0], axis=1)
        self.sphere = centers_m[0], float((gaps_m + scene.radii_m).max())  # around the target, of all objects
        # A face has one light. Faces of the house come first, then those of each object, as bodies do.
        bodies = [(scene.house, np.eye(4)), *zip(scene.objects, scene.T_world_object, strict=True)]
        self.starts = np.cumsum([0, *(len(rays.normals) for rays, _ in bodies)])[:-1]
        self.lights = np.concatenate([self._light_of_faces(*body) for body in bodies], axis=1)
        side = np.array([to_light[1], -to_light[0], 0]) / np.hypot(*to_light[:2])
        self.axes = np.stack([to_light, side, np.cross(to_light, side)]).astype(np.float32)

    def frame(self) -> Frame:
        h, w = self.camera.height_px, self.camera.width_px
        near = np.zeros(h * w, np.bool_)
        near[target_pixels(self.camera, self.sphere[0], _MARGIN * self.sphere[1])] = True
        rgb, depth_m = np.empty(h * w, np.int32), np.empty(h * w, np.float32)
        body, bare = np.empty(h * w, np.int16), replace(self.scene, objects=())
        for visible, pixels in (self.scene, np.flatnonzero(near)), (bare, np.flatnonzero(~near)):
            for k in range(0, len(pixels), _IN_CACHE):
                block = pixels[k : k + _IN_CACHE]
                seen = cast_surfaces(visible, self.camera, block, self._surface, np.zeros(2, np.int32))
                rgb[block], (_, depth_m[block], body[block], _) = self._lit(*seen), seen
        colours = np.ascontiguousarray(rgb.view(np.uint8).reshape(h, w, 4)[:, :, :3])
        return Frame(self.camera, colours, depth_m.reshape(h, w), body.reshape(h, w))

    def _light_of_faces(self, rays: RayMesh, T: F64) -> F32:
        """Light (2, F) on a body's faces in shadow and without; the same where they do not face the lamp."""
        vectors = np.stack([self.to_light, np.array(_FILL), self.eye_m - T[:3, 3]]) @ T[:3, :3]
        light, fill, eye_m = (rays.normals @ vectors.T.astype(np.float32)).T
        side = np.where(eye_m > rays.offsets_m, np.float32(1), np.float32(-1))  # that the camera sees
        ambient = _AMBIENT + side * fill
        return np.stack([ambient, ambient + _LIGHT * np.maximum(side * light, 0)])

    def _surface(self, rays: RayMesh, hits: Hits, *_: F32 | None) -> I32:
        """Face and packed colour of hits, (N, 2)."""
        values = np.column_stack([hits.face, hits.face])
        rgb = values.view(np.uint8)[:, 4:7]
        rgb[:] = surface_colour(rays, hits)
        if rays is self.scene.house and self.cover.textures is not None:
            self.cover.textures.paint(rgb, hits.face, hits.barycentric)
        return values

    def _lit(self, values: I32, depth_m: F32, body: I16, rays: F32) -> I32:
        """Packed colours (N,) of pixels, of which `values` are those of `_surface`."""
        # Coordinates are rows: NumPy is several times as fast along long rows as along triples.
        rays = np.ascontiguousarray(rays.T)
        points_m = np.asarray(self.eye_m[:, None] + depth_m * rays, np.float32)
        face, packed = values[:, 0] + self.starts.take(body), values[:, 1].copy()  # any face without a body
        shadow, light = self.lights.take(face, axis=1)
        rows = np.flatnonzero((light > shadow) & (points_m[2] < _LIGHT_M))
        rows = rows[self._in_shadow(points_m.take(rows, axis=1))]
        light[rows] = shadow[rows]
        pattern = self.cover.pattern.take(face, mode="clip")
        rows = np.flatnonzero((pattern > 0) & (body == 0))
        normals = self.scene.house.normals.take(face[rows], axis=0).T
        facing = np.abs(np.einsum("ij,ij->j", normals, rays.take(rows, axis=1)))
        seen_m = depth_m[rows] / (np.float32(self.camera.fx_px) * np.maximum(facing, np.float32(1e-3)))
        light[rows] *= self.cover.shares(pattern[rows], points_m.take(rows, axis=1), normals, seen_m)
        rgb = packed.view(np.uint8).reshape(-1, 4)[:, :3]
        for channel in rgb.T:
            channel[:] = np.minimum(channel * light, 255)
        empty = np.flatnonzero(body < 0)
        rgb[empty] = _outside(self.eye_m, rays[:, empty].T, self.rooms, self.ceiling_m)
        return packed

    def _in_shadow(self, points_m: F32) -> npt.NDArray[np.bool_]:
        """Whether something lies between points (3, N) and the light."""
        starts_m = np.asarray(points_m.T + _OFF_SURFACE_M * self.to_light, np.float32, order="C")
        towards = np.tile(self.to_light, (len(starts_m), 1))
        limits = (_LIGHT_M - points_m[2]) / self.to_light[2]
        dark = occluded(self.scene.house, starts_m, towards, limits)
        # Objects lie around the target: few points can be in the shadow of any.
        across = self.axes @ points_m
        near = self._below(across, *self.sphere)
        across, scene = across.take(near, axis=1), self.scene
        for rays, T, radius_m in zip(scene.objects, scene.T_world_object, scene.radii_m, strict=True):
            if len(rows := near[self._below(across, T[:3, 3], radius_m)]):
                local = into_frame(T, starts_m.take(rows, axis=0), towards[: len(rows)])
                dark[rows] |= occluded(rays, *local, limits[rows])
        return dark

    def _below(self, across: F32, centre_m: F64, radius_m: float) -> I64:
        """Rows of points (3, N), along `axes`, whose ray to the light passes through the sphere."""
        along, left, up = (self.axes @ centre_m.astype(np.float32))[:, None] - across
        return np.flatnonzero((left * left + up * up < radius_m**2) & (along > -radius_m))


def _outside(eye_m: F32, rays: F32, rooms: Sequence[Room], ceiling_m: float) -> F32:
    """Colours (N, 3) along rays that hit nothing: the ceiling of a room, the sky, or the ground."""
    up = rays[:, 2] / np.linalg.norm(rays, axis=1)
    rgb = np.where(up[:, None] < 0, _GROUND, _HORIZON + up[:, None] * (_ZENITH - _HORIZON))
    rise = (ceiling_m - eye_m[2]) / np.where(up > 0, rays[:, 2], np.inf)
    xy = (eye_m + rise[:, None] * rays)[:, :2].astype(np.float64)
    for room in rooms:
        rgb[(up > 0) & inside_polygon(xy, room.polygon_m)] = _CEILING
    return rgb
