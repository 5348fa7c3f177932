"""Settling by SAPIEN's PhysX on the CPU. Needs no render device."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from schemas.specification import SettleParams
from workers.geometry.mesh import F32, F64
from workers.geometry.transforms import pose, quaternion_wxyz
from workers.objects.model import ObjectModel
from workers.settling.settler import SettleResult

with warnings.catch_warnings():
    # SAPIEN warns about a missing Vulkan loader at import; physics alone does not use it.
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx

_UNSCALED = [1.0, 1.0, 1.0]
_LOOK_EVERY = 5  # steps between looks at the speeds: reading them costs as much as a step


def settle_sapien(
    static_parts_m: Sequence[F32],
    objects: Sequence[ObjectModel],
    T_world_object: F64,
    params: SettleParams,
) -> SettleResult:
    """Let the objects fall until all have rested for `rest_steps` steps, or `max_steps` are over.

    A scene is built anew each time: a reused one carries contacts and sleep counters over, and
    outcomes then depend on what came before.
    """
    system = physx.PhysxCpuSystem()
    scene = sapien.Scene([system])
    scene.set_timestep(params.timestep_s)
    material = physx.PhysxMaterial(params.friction, params.friction, 0.0)
    _add_static(scene, static_parts_m, material)
    bodies = [
        _add_object(scene, model, T, material) for model, T in zip(objects, T_world_object, strict=True)
    ]

    steps, resting = 0, 0
    speed = angular = np.inf
    while steps < params.max_steps and resting < params.rest_steps:
        for _ in range(min(_LOOK_EVERY, params.max_steps - steps)):
            scene.step()
            steps += 1
        speed = max((float(np.linalg.norm(b.linear_velocity)) for b in bodies), default=0.0)
        angular = max((float(np.linalg.norm(b.angular_velocity)) for b in bodies), default=0.0)
        if not (np.isfinite(speed) and np.isfinite(angular)):
            break
        calm = speed < params.rest_speed_mps and angular < params.rest_angular_speed_radps
        resting = resting + _LOOK_EVERY if calm else 0

    final = np.stack([_pose_of(b) for b in bodies]) if bodies else np.zeros((0, 4, 4))
    return SettleResult(
        T_world_object=final,
        steps=steps,
        at_rest=resting >= params.rest_steps,
        residual_speed_mps=speed,
        residual_angular_radps=angular,
        penetration_m=_deepest_contact(scene),
    )


def _add_static(scene: sapien.Scene, static_parts_m: Sequence[F32], material: physx.PhysxMaterial) -> None:
    body = physx.PhysxRigidStaticComponent()
    for part in static_parts_m:
        # PhysX wants hulls near their own origin: cooking loses precision far from it.
        centre_m = part.mean(axis=0)
        shape = physx.PhysxCollisionShapeConvexMesh(
            np.ascontiguousarray(part - centre_m, np.float32), _UNSCALED, material
        )
        shape.set_local_pose(sapien.Pose(centre_m.tolist()))
        body.attach(shape)
    entity = sapien.Entity()
    entity.add_component(body)
    scene.add_entity(entity)


def _add_object(
    scene: sapien.Scene, model: ObjectModel, T_world_object: F64, material: physx.PhysxMaterial
) -> physx.PhysxRigidDynamicComponent:
    body = physx.PhysxRigidDynamicComponent()
    for part in model.convex_parts_m:
        body.attach(
            physx.PhysxCollisionShapeConvexMesh(np.ascontiguousarray(part, np.float32), _UNSCALED, material)
        )
    # Scaling mass and inertia together keeps the mass distribution of the parts, which
    # overlap a little, at the object's own mass.
    scale = model.mass_kg / body.mass
    inertia = np.asarray(body.inertia, np.float32) * np.float32(scale)
    body.set_mass(model.mass_kg)
    body.set_inertia(inertia.tolist())
    entity = sapien.Entity()
    entity.add_component(body)
    entity.set_pose(_sapien_pose(T_world_object))
    scene.add_entity(entity)
    return body


def _sapien_pose(T: F64) -> sapien.Pose:
    return sapien.Pose(T[:3, 3].tolist(), quaternion_wxyz(T[:3, :3]).tolist())


def _pose_of(body: physx.PhysxRigidDynamicComponent) -> F64:
    p = body.entity.pose
    return pose(np.asarray(p.p, np.float64), np.asarray(p.q, np.float64))


def _deepest_contact(scene: sapien.Scene) -> float:
    """Depth in metres of the deepest contact point of the last step; 0 when nothing touches."""
    depths = [point.separation for contact in scene.get_contacts() for point in contact.points]
    return max(0.0, -min(depths)) if depths else 0.0
