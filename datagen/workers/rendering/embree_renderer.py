"""RGB-D pixels by Embree: texture colours, two lights, no render device.

Pixels are cast one by one, so a caller that needs a sample of the frame pays for that sample
only; the values are those of the whole frame.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64, U8
from datagen.workers.rendering.frame import Camera, Frame, Pixels, SceneGeometry, pixel_directions
from datagen.workers.rendering.rays import (
    MISS,
    Hits,
    RayMesh,
    RayScene,
    first_hits,
    house_rays,
    into_frame,
    object_rays,
)

_BACKGROUND_RGB = (225, 232, 240)
_AMBIENT, _LAMP, _HEAD = 0.50, 0.35, 0.30
_LAMP_DIRECTION = np.array([0.35, 0.25, 0.90], np.float32) / np.float32(np.sqrt(0.35**2 + 0.25**2 + 0.9**2))


def ray_scene(scene: SceneGeometry) -> RayScene:
    """A scene ready for rays."""
    return RayScene(
        house_rays(scene.house),
        [object_rays(model) for model in scene.objects],
        np.array([model.radius_m for model in scene.objects]),
        scene.T_world_object,
    )


def render_embree(scene: SceneGeometry, camera: Camera) -> Frame:
    """The whole frame of a scene."""
    return render_rays(ray_scene(scene), camera)


def render_rays(scene: RayScene, camera: Camera) -> Frame:
    """The whole frame of a scene that is ready for rays."""
    h, w = camera.height_px, camera.width_px
    pixels = cast_pixels(scene, camera, np.arange(h * w))
    return Frame(camera, pixels.rgb.reshape(h, w, 3), pixels.depth_m.reshape(h, w), pixels.body.reshape(h, w))


def cast_pixels(scene: RayScene, camera: Camera, pixels: npt.NDArray[np.int64]) -> Pixels:
    """Colour, depth and body of chosen pixels, given as flat indices (N,) into the frame."""
    n = len(pixels)
    rotation = camera.T_world_camera[:3, :3].astype(np.float32)
    directions = np.ascontiguousarray(pixel_directions(camera, pixels) @ rotation.T)
    origins = np.tile(camera.T_world_camera[:3, 3].astype(np.float32), (n, 1))

    # Directions have depth 1, so the ray parameter is the depth along the camera's z axis.
    hits = first_hits(scene.house, origins, directions)
    depth_m = hits.parameter.copy()
    body = np.where(hits.face >= 0, 0, -1).astype(np.int16)
    rgb = np.empty((n, 3), np.uint8)
    rgb[:] = _BACKGROUND_RGB
    shown = hits.face >= 0
    rgb[shown] = _shade(scene.house, _take(hits, shown), directions[shown])

    eye_m = camera.T_world_camera[:3, 3]
    for k, rays in enumerate(scene.objects):
        T = scene.T_world_object[k]
        near = _towards_sphere(eye_m, directions, T[:3, 3], float(scene.radii_m[k]))
        local_origins, local_directions = into_frame(T, origins[near], directions[near])
        found = first_hits(rays, local_origins, local_directions)
        closer = found.parameter < depth_m[near]
        rows = near[closer]
        depth_m[rows], body[rows] = found.parameter[closer], k + 1
        rgb[rows] = _shade(rays, _take(found, closer), local_directions[closer], T[:3, :3].astype(np.float32))
    depth_m[depth_m >= MISS] = 0.0
    return Pixels(rgb, depth_m, body)


def _take(hits: Hits, rows: npt.NDArray[np.bool_]) -> Hits:
    return Hits(hits.parameter[rows], hits.face[rows], hits.barycentric[rows])


def _towards_sphere(eye_m: F64, directions: F32, centre_m: F64, radius_m: float) -> npt.NDArray[np.int64]:
    """Rows whose ray passes within the sphere (a little more, for rounding)."""
    rel = (centre_m - eye_m).astype(np.float32)
    along = directions @ rel
    length2 = np.einsum("ij,ij->i", directions, directions)
    gap2 = float(rel @ rel) - along**2 / length2
    return np.flatnonzero((gap2 < (radius_m * 1.01 + 1e-3) ** 2) & (along > -radius_m))


def _shade(rays: RayMesh, hits: Hits, directions: F32, R_world_mesh: F32 | None = None) -> U8:
    """Surface colour times ambient light, a lamp from above and a light at the camera; (N, 3).

    `directions` are in the mesh's frame; two-sided, because scans have holes.
    """
    colour = _surface_colour(rays, hits).astype(np.float32)
    normals = rays.normals[hits.face]
    facing = np.einsum("ij,ij->i", normals, directions)
    facing /= np.sqrt(np.einsum("ij,ij->i", directions, directions))
    lamp = _LAMP_DIRECTION if R_world_mesh is None else _LAMP_DIRECTION @ R_world_mesh
    # A normal that points away from the camera belongs to the surface's other side.
    lit = np.maximum((normals @ lamp) * -np.sign(facing), 0.0)
    light = _AMBIENT + _LAMP * lit + _HEAD * np.abs(facing)
    return np.minimum(colour * light[:, None], 255.0).astype(np.uint8)


def _surface_colour(rays: RayMesh, hits: Hits) -> U8:
    texture = rays.mesh.texture
    if texture is None:
        return rays.mesh.face_rgb[hits.face]
    u, v = hits.barycentric[:, :1], hits.barycentric[:, 1:]
    corners = texture.uv[rays.mesh.faces[hits.face]]  # (N, 3, 2)
    uv = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    height, width = texture.image.shape[:2]
    column = np.clip((uv[:, 0] % 1.0) * width, 0, width - 1).astype(np.int64)
    row = np.clip((1.0 - uv[:, 1] % 1.0) * height, 0, height - 1).astype(np.int64)
    return texture.image[row, column]
