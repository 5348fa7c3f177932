"""Rays and RGB-D pixels by Embree: texture colours, two lights, no render device.

Every object and every house keeps a bounding volume hierarchy in its own frame: a scene builds none, and
scans are used undecimated. Pixels are cast one by one, so that a sample of a frame costs only that sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64, I32, U8, Mesh, concatenate, face_normals
from datagen.workers.houses.house import House
from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering import I16, Camera, Frame, Pixels, SceneGeometry, pixel_directions

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

MISS = np.float32(1e37)  # Embree's parameter of a ray that hit nothing
_APART_M = 1e-4  # of a polyhedron from its mesh, which may be flat


@dataclass(frozen=True, eq=False)
class RayMesh:
    """A mesh with its hierarchy and face normals."""

    mesh: Mesh
    hierarchy: EmbreeScene
    normals: F32  # (F, 3), unit, mesh frame
    offsets_m: F32  # (F,) of the faces' planes from the origin, along their normals

    @cached_property
    def around_m(self) -> F64:
        """Corners (K, 3), mesh frame, of a convex polyhedron of at most 26 faces that holds the mesh."""
        from scipy.spatial import HalfspaceIntersection  # slow to import

        axes = np.array([axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if any(axis)])
        points_m = self.mesh.vertices_m.astype(np.float64)
        faces = np.column_stack([axes, -(points_m @ axes.T).max(0) - _APART_M])
        return HalfspaceIntersection(faces, points_m.mean(0)).intersections


@dataclass(frozen=True, eq=False)
class RayScene:
    """A house and placed objects, ready for rays."""

    house: RayMesh
    objects: Sequence[RayMesh]
    radii_m: F64  # (K,), bounding spheres around the object origins
    T_world_object: F64  # (K, 4, 4)


def ray_mesh(mesh: Mesh) -> RayMesh:
    """Build the hierarchy of a mesh that has at least one face."""
    # Not at the top: models are judged, and jobs are cancelled, where Embree is not installed.
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    hierarchy = EmbreeScene(_device())
    TriangleMesh(
        hierarchy,
        np.ascontiguousarray(mesh.vertices_m, np.float32),
        np.ascontiguousarray(mesh.faces, np.int32),
    )
    normals = face_normals(mesh.vertices_m[mesh.faces]).astype(np.float32)
    offsets_m = np.einsum("ij,ij->i", normals, mesh.vertices_m[mesh.faces[:, 0]])
    rays = RayMesh(mesh, hierarchy, normals, offsets_m)
    # Embree builds on the first query; doing it here keeps that cost out of the stages that time rays.
    nearest(rays, np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return rays


@cache
def _device() -> Any:
    """The one device of this process: each takes a key of thread-local storage, of which there are 1024.

    By default embreex makes one for each mesh: a thousand objects ended the process (segmentation fault).
    """
    from embreex.rtcore import EmbreeDevice

    return EmbreeDevice()


# An entry lives as long as its house or object.
_kept: WeakKeyDictionary[House | ObjectModel, RayMesh] = WeakKeyDictionary()


def house_rays(house: House) -> RayMesh:
    """One hierarchy over all bodies of a house, world frame; built once for each `house`."""
    if house not in _kept:
        _kept[house] = ray_mesh(concatenate([body.visual for body in house.bodies]))
    return _kept[house]


def object_rays(model: ObjectModel) -> RayMesh:
    """The hierarchy of an object's visual mesh, object frame; built once for each `model`."""
    if model not in _kept:
        _kept[model] = ray_mesh(model.visual)
    return _kept[model]


def nearest(rays: RayMesh, origins_m: F32, directions: F32) -> F32:
    """Ray parameter (N,) of the first hit: hit = origin + parameter * direction; MISS where none.

    Directions need not be unit vectors, so a parameter means the same in every rigid frame.
    """
    distances: F32 = rays.hierarchy.run(origins_m, directions, query="DISTANCE")
    return np.where(distances >= MISS, MISS, distances)


def occluded(rays: RayMesh, origins_m: F32, directions: F32, limits: F32) -> npt.NDArray[np.bool_]:
    """Whether anything lies on each ray before its limit; all (N,) or (N, 3)."""
    hits: I32 = rays.hierarchy.run(origins_m, directions, limits, query="OCCLUDED")
    return hits >= 0


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of N rays on one mesh."""

    parameter: F32  # (N,), MISS where none
    face: I32  # (N,), -1 where none
    barycentric: F32  # (N, 2), weights of the face's second and third vertex


def first_hits(rays: RayMesh, origins_m: F32, directions: F32) -> Hits:
    """First hits with the face and the point on it; origins and directions are (N, 3)."""
    out = rays.hierarchy.run(origins_m, directions, output=True)
    return Hits(out["tfar"], out["primID"], np.stack([out["u"], out["v"]], axis=1))


def into_frame(T_world_body: F64, origins_m: F32, directions: F32) -> tuple[F32, F32]:
    """World rays (N, 3) as rays in a body's frame."""
    R = T_world_body[:3, :3].astype(np.float32)
    # Moving by the body's position first keeps float32 exact where house coordinates are large.
    local = (origins_m - T_world_body[:3, 3].astype(np.float32)) @ R
    return np.ascontiguousarray(local, np.float32), np.ascontiguousarray(directions @ R, np.float32)


# Values (N, C) of hits: rays (N, 3) are in the frame of the mesh, whose rotation is None in the world frame.
Values = npt.NDArray[Any]
Surface = Callable[[RayMesh, Hits, F32, F32 | None], Values]

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
    return Pixels(*cast_surfaces(scene, camera, pixels, _shade, np.array(_BACKGROUND_RGB, np.uint8))[:3])


def cast_surfaces(
    scene: RayScene, camera: Camera, pixels: npt.NDArray[np.int64], surface: Surface, nothing: Values
) -> tuple[Values, F32, I16, F32]:
    """Values (N, C) of chosen pixels' surfaces, their depth (N,) and body (N,), and the rays (N, 3), world.

    `surface` gives the values of hits; those of pixels without one are `nothing` (C,).
    """
    n = len(pixels)
    rotation = camera.T_world_camera[:3, :3].astype(np.float32)
    directions = np.ascontiguousarray(pixel_directions(camera, pixels) @ rotation.T)
    origins = np.tile(camera.T_world_camera[:3, 3].astype(np.float32), (n, 1))

    # Directions have depth 1, so the ray parameter is the depth along the camera's z axis.
    hits = first_hits(scene.house, origins, directions)
    depth_m = hits.parameter.copy()
    body = np.where(hits.face >= 0, 0, -1).astype(np.int16)
    values = np.tile(nothing, (n, 1))
    shown = np.flatnonzero(hits.face >= 0)
    values[shown] = surface(scene.house, _take(hits, shown), directions.take(shown, axis=0), None)

    eye_m = camera.T_world_camera[:3, 3]
    for k, rays in enumerate(scene.objects):
        T = scene.T_world_object[k]
        near = _towards_sphere(eye_m, directions, T[:3, 3], float(scene.radii_m[k]))
        local_origins, local_directions = into_frame(T, origins[: len(near)], directions.take(near, axis=0))
        found = first_hits(rays, local_origins, local_directions)
        closer = np.flatnonzero(found.parameter < depth_m[near])
        rows = near[closer]
        depth_m[rows], body[rows] = found.parameter[closer], k + 1
        R = T[:3, :3].astype(np.float32)
        values[rows] = surface(rays, _take(found, closer), local_directions.take(closer, axis=0), R)
    depth_m[depth_m >= MISS] = 0.0
    return values, depth_m, body, directions


def _take(hits: Hits, rows: npt.NDArray[np.int64]) -> Hits:
    return Hits(hits.parameter[rows], hits.face[rows], hits.barycentric.take(rows, axis=0))


def _towards_sphere(eye_m: F64, directions: F32, centre_m: F64, radius_m: float) -> npt.NDArray[np.int64]:
    """Rows whose ray passes within the sphere (a little more, for rounding)."""
    rel = (centre_m - eye_m).astype(np.float32)
    along = directions @ rel
    length2 = np.einsum("ij,ij->i", directions, directions)
    gap2 = float(rel @ rel) - along**2 / length2
    return np.flatnonzero((gap2 < (radius_m * 1.01 + 1e-3) ** 2) & (along > -radius_m))


def _shade(rays: RayMesh, hits: Hits, directions: F32, R_world_mesh: F32 | None) -> U8:
    """Surface colour times ambient light, a lamp from above and a light at the camera; (N, 3).

    `directions` are in the mesh's frame; two-sided, because scans have holes.
    """
    colour = surface_colour(rays, hits).astype(np.float32)
    normals = rays.normals[hits.face]
    facing = np.einsum("ij,ij->i", normals, directions)
    facing /= np.sqrt(np.einsum("ij,ij->i", directions, directions))
    lamp = _LAMP_DIRECTION if R_world_mesh is None else _LAMP_DIRECTION @ R_world_mesh
    # A normal that points away from the camera belongs to the surface's other side.
    lit = np.maximum((normals @ lamp) * -np.sign(facing), 0.0)
    light = _AMBIENT + _LAMP * lit + _HEAD * np.abs(facing)
    return np.minimum(colour * light[:, None], 255.0).astype(np.uint8)


def surface_colour(rays: RayMesh, hits: Hits) -> U8:
    """Colours (N, 3) of hits without light: of the texture, or of the face."""
    texture = rays.mesh.texture
    if texture is None:
        return rays.mesh.face_rgb.take(hits.face, axis=0)
    u, v = hits.barycentric[:, :1], hits.barycentric[:, 1:]
    corners = texture.uv[rays.mesh.faces[hits.face]]  # (N, 3, 2)
    uv = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    height, width = texture.image.shape[:2]
    column = np.clip((uv[:, 0] % 1.0) * width, 0, width - 1).astype(np.int64)
    row = np.clip((1.0 - uv[:, 1] % 1.0) * height, 0, height - 1).astype(np.int64)
    return texture.image[row, column]
