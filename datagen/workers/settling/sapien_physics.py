"""SAPIEN's PhysX on the CPU, without a render device: bodies of convex parts, and settling."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from datagen.schemas.specification import SettleParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import pose, quaternion_wxyz
from datagen.workers.objects.model import ObjectModel
from datagen.workers.settling import SettleResult, fall

with warnings.catch_warnings():
    # SAPIEN warns about a missing Vulkan loader at import; physics alone does not use it.
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx

_UNSCALED = [1.0, 1.0, 1.0]


def settle_sapien(
    static_parts_m: Sequence[F32], objects: Sequence[ObjectModel], T_world_object: F64, params: SettleParams
) -> SettleResult:
    """Let the objects fall until all have rested for `rest_steps` steps, or `max_steps` are over.

    A new physics scene is built each time: a reused one keeps contacts and sleep counters, so outcomes would
    depend on earlier calls.
    """
    system = physx.PhysxCpuSystem()
    scene = sapien.Scene([system])
    scene.set_timestep(params.timestep_s)
    material = physx.PhysxMaterial(params.friction, params.friction, 0.0)
    add_static(scene, static_parts_m, material)
    bodies = [
        add_object(scene, model.convex_parts_m, model.mass_kg, T, material)
        for model, T in zip(objects, T_world_object, strict=True)
    ]

    def speeds() -> tuple[float, float]:
        motions = np.array([(b.linear_velocity, b.angular_velocity) for b in bodies]).reshape(-1, 2, 3)
        speed, angular = np.sqrt(np.vecdot(motions, motions)).max(0, initial=0.0).tolist()
        return speed, angular

    steps, at_rest, speed = fall(scene.step, speeds, params)
    final = np.stack([pose_of(b) for b in bodies]) if bodies else np.zeros((0, 4, 4))
    return SettleResult(
        T_world_object=final,
        steps=steps,
        at_rest=at_rest,
        residual_speed_mps=speed,
        penetration_m=_deepest_contact(scene),
    )


def _deepest_contact(scene: sapien.Scene) -> float:
    """Depth in metres of the deepest contact point of the last step; 0 when nothing touches."""
    depths = [point.separation for contact in scene.get_contacts() for point in contact.points]
    return max(0.0, -min(depths)) if depths else 0.0


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
