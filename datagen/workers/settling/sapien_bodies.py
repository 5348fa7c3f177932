"""Bodies of convex parts in a SAPIEN scene, for every use of its physics."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import pose, quaternion_wxyz

with warnings.catch_warnings():
    # SAPIEN warns about a missing Vulkan loader at import; physics alone does not use it.
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx

_UNSCALED = [1.0, 1.0, 1.0]


def pad_material(object_friction: float, finger_friction: float) -> physx.PhysxMaterial:
    """Material of a finger's pad whose friction with the object is the geometric mean of both.

    Rubber holds a soapy bottle far worse than a dry one. PhysX uses the arithmetic mean, in which the
    object's friction hardly counts; the pad's friction makes that mean equal to the geometric one.
    """
    pad = max(0.0, 2 * math.sqrt(object_friction * finger_friction) - object_friction)
    return physx.PhysxMaterial(pad, pad, 0.0)


def static_body(parts_m: Sequence[F32], material: physx.PhysxMaterial) -> physx.PhysxRigidStaticComponent:
    """One static body of convex parts (V, 3) each in the world frame."""
    body = physx.PhysxRigidStaticComponent()
    for part in parts_m:
        # PhysX needs hulls near their own origin: cooking loses precision far from it.
        centre_m = part.mean(axis=0)
        shape = convex_shape(part - centre_m, material)
        shape.set_local_pose(sapien.Pose(centre_m.tolist()))
        body.attach(shape)
    return body


def add_static(scene: sapien.Scene, parts_m: Sequence[F32], material: physx.PhysxMaterial) -> None:
    """Adds a `static_body` to a scene."""
    entity = sapien.Entity()
    entity.add_component(static_body(parts_m, material))
    scene.add_entity(entity)


def add_object(
    scene: sapien.Scene,
    parts_m: Sequence[F32],
    mass_kg: float,
    T_world_object: F64,
    material: physx.PhysxMaterial,
) -> physx.PhysxRigidDynamicComponent:
    """Add a dynamic body of convex parts (V, 3) each in the object's frame, at a pose (4, 4)."""
    body = object_body(parts_m, mass_kg, material)
    entity = sapien.Entity()
    entity.add_component(body)
    entity.set_pose(sapien_pose(T_world_object))
    scene.add_entity(entity)
    return body


def object_body(
    parts_m: Sequence[F32], mass_kg: float, material: physx.PhysxMaterial
) -> physx.PhysxRigidDynamicComponent:
    """A dynamic body of convex parts (V, 3) each, in no scene yet."""
    body = physx.PhysxRigidDynamicComponent()
    for part in parts_m:
        body.attach(convex_shape(part, material))
    # Scaling mass and inertia together keeps the mass distribution of the parts, which
    # overlap a little, at the object's own mass.
    scale = mass_kg / body.mass
    inertia = np.asarray(body.inertia, np.float32) * np.float32(scale)
    body.set_mass(mass_kg)
    body.set_inertia(inertia.tolist())
    return body


def convex_shape(part_m: F32, material: physx.PhysxMaterial) -> physx.PhysxCollisionShapeConvexMesh:
    """The hull of the points (V, 3), in the frame of the body it is attached to."""
    return physx.PhysxCollisionShapeConvexMesh(np.ascontiguousarray(part_m, np.float32), _UNSCALED, material)


def sapien_pose(T: F64) -> sapien.Pose:
    """A transform (4, 4) as a SAPIEN pose."""
    return sapien.Pose(T[:3, 3].tolist(), quaternion_wxyz(T[:3, :3]).tolist())


def pose_of(component: sapien.Component) -> F64:
    """T_world_entity (4, 4) of the entity that carries a component: a body, or a link."""
    p = component.entity.pose
    return pose(np.asarray(p.p, np.float64), np.asarray(p.q, np.float64))
