"""Ray casting with Embree over bodies that keep their own frames.

Every object and every house has its own bounding volume hierarchy, built once and kept; a ray is
transformed into the frame of each body that it may hit. A scene therefore builds no hierarchy,
and the full scan meshes are used, undecimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from datagen.workers.geometry.mesh import F32, F64, I32, Mesh, concatenate, face_normals
from datagen.workers.houses.house import House
from datagen.workers.objects.model import ObjectModel

MISS = np.float32(1e37)  # Embree's parameter of a ray that hit nothing


@dataclass(frozen=True, eq=False)
class RayMesh:
    """A mesh with its hierarchy and face normals."""

    mesh: Mesh
    hierarchy: EmbreeScene
    normals: F32  # (F, 3), unit, mesh frame
    box_corners_m: F32  # (8, 3), of the bounding box, mesh frame


@dataclass(frozen=True, eq=False)
class RayScene:
    """A house and placed objects, ready for rays."""

    house: RayMesh
    objects: Sequence[RayMesh]
    radii_m: F64  # (K,), bounding spheres around the object origins
    T_world_object: F64  # (K, 4, 4)


def ray_mesh(mesh: Mesh) -> RayMesh:
    """Build the hierarchy of a mesh that has at least one face."""
    hierarchy = EmbreeScene()
    TriangleMesh(
        hierarchy,
        np.ascontiguousarray(mesh.vertices_m, np.float32),
        np.ascontiguousarray(mesh.faces, np.int32),
    )
    normals = face_normals(mesh.vertices_m[mesh.faces])
    low, high = mesh.vertices_m.min(0), mesh.vertices_m.max(0)
    corners_m = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(8, 3)
    rays = RayMesh(mesh, hierarchy, normals.astype(np.float32), corners_m)
    # Embree builds on the first query; doing it here keeps that cost out of the stages that time rays.
    nearest(rays, np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return rays


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
