"""Settling by SAPIEN's PhysX on the CPU. Needs no render device."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from datagen.schemas.specification import SettleParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects.model import ObjectModel
from datagen.workers.settling.sapien_bodies import add_object, add_static, pose_of
from datagen.workers.settling.settler import SettleResult

with warnings.catch_warnings():
    # SAPIEN warns about a missing Vulkan loader at import; physics alone does not use it.
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx

_CHECK_EVERY = 5  # steps between checks of the speeds: reading them costs as much as a step


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

    steps, resting = 0, 0
    speed = angular = np.inf
    while steps < params.max_steps and resting < params.rest_steps:
        for _ in range(min(_CHECK_EVERY, params.max_steps - steps)):
            scene.step()
            steps += 1
        speed = max((float(np.linalg.norm(b.linear_velocity)) for b in bodies), default=0.0)
        angular = max((float(np.linalg.norm(b.angular_velocity)) for b in bodies), default=0.0)
        if not (np.isfinite(speed) and np.isfinite(angular)):
            break
        calm = speed < params.rest_speed_mps and angular < params.rest_angular_speed_radps
        resting = resting + _CHECK_EVERY if calm else 0

    final = np.stack([pose_of(b) for b in bodies]) if bodies else np.zeros((0, 4, 4))
    return SettleResult(
        T_world_object=final,
        steps=steps,
        at_rest=resting >= params.rest_steps,
        residual_speed_mps=speed,
        residual_angular_radps=angular,
        penetration_m=_deepest_contact(scene),
    )


def _deepest_contact(scene: sapien.Scene) -> float:
    """Depth in metres of the deepest contact point of the last step; 0 when nothing touches."""
    depths = [point.separation for contact in scene.get_contacts() for point in contact.points]
    return max(0.0, -min(depths)) if depths else 0.0
