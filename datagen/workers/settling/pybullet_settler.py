"""Settling by Bullet. Needs no system libraries, and cross-checks PhysX."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pybullet  # pyright: ignore[reportMissingImports]  # no wheels from Python 3.12 on
from scipy.spatial import ConvexHull, QhullError

from datagen.schemas.errors import InputError
from datagen.schemas.specification import SettleParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import inverse, pose, quaternion_wxyz
from datagen.workers.objects.model import ObjectModel
from datagen.workers.settling import SettleResult, fall

_GRAVITY_MPS2 = 9.81
# PhysX's defaults; Bullet's own would slow falls and rolls down.
_LINEAR_DAMPING, _ANGULAR_DAMPING = 0.0, 0.05
# Bullet inflates every hull by 1 mm, so that objects would rest 2 mm above each other.
_MARGIN_M = 0.0


def settle_pybullet(
    static_parts_m: Sequence[F32], objects: Sequence[ObjectModel], T_world_object: F64, params: SettleParams
) -> SettleResult:
    """Let the objects fall until all have rested for `rest_steps` steps, or `max_steps` are over.

    Every call has a physics world of its own. Raises InputError if Bullet cannot make one, or if a
    part of an object has no volume.
    """
    world = pybullet.connect(pybullet.DIRECT)
    if world < 0:
        fix = "Run fewer scenes at once in one process, or use another settler"
        raise InputError("settle.engine", "pybullet", "Bullet cannot open another physics world", fix)
    try:
        with tempfile.TemporaryDirectory(prefix="datagen-bullet-") as folder:
            bodies, T_object_inertial = _fill(
                world, Path(folder), static_parts_m, objects, T_world_object, params
            )
        steps, at_rest, speed = fall(
            partial(pybullet.stepSimulation, physicsClientId=world), partial(_speeds, world, bodies), params
        )
        final = [
            _pose_of(world, body) @ inverse(T) for body, T in zip(bodies, T_object_inertial, strict=True)
        ]
        return SettleResult(
            T_world_object=np.stack(final) if final else np.zeros((0, 4, 4)),
            steps=steps,
            at_rest=at_rest,
            residual_speed_mps=speed,
            penetration_m=_deepest_contact(world),
        )
    finally:
        pybullet.disconnect(physicsClientId=world)


def _fill(
    world: int,
    folder: Path,
    static_parts_m: Sequence[F32],
    objects: Sequence[ObjectModel],
    T_world_object: F64,
    params: SettleParams,
) -> tuple[list[int], list[F64]]:
    """Add all bodies; returns the objects' body numbers and T_object_inertial (4, 4) each.

    Bullet reports the pose of the inertial frame: centre of mass and principal axes.
    """
    pybullet.setGravity(0, 0, -_GRAVITY_MPS2, physicsClientId=world)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=params.timestep_s, deterministicOverlappingPairs=1, physicsClientId=world
    )
    if static_parts_m:
        _add_body(world, folder / "static.obj", static_parts_m, params, baseMass=0.0)
    bodies: list[int] = []
    frames: list[F64] = []
    for k, (model, T) in enumerate(zip(objects, T_world_object, strict=True)):
        properties = mass_properties(model.name, model.convex_parts_m, model.mass_kg)
        T_object_inertial = pose(properties.centre_m, quaternion_wxyz(properties.R_body_principal))
        body = _add_body(
            world,
            folder / f"object-{k}.obj",
            model.convex_parts_m,
            params,
            baseMass=model.mass_kg,
            basePosition=T[:3, 3].tolist(),
            baseOrientation=_xyzw(T),
            baseInertialFramePosition=T_object_inertial[:3, 3].tolist(),
            baseInertialFrameOrientation=_xyzw(T_object_inertial),
        )
        # By default Bullet uses the inertia of the bounding box.
        pybullet.changeDynamics(
            body, -1, localInertiaDiagonal=properties.inertia_kgm2.tolist(), physicsClientId=world
        )
        bodies.append(body)
        frames.append(T_object_inertial)
    return bodies, frames


def _add_body(
    world: int, file: Path, parts_m: Sequence[F32], params: SettleParams, **placing: float | list[float]
) -> int:
    """A body of convex parts, from an OBJ file: Bullet accepts more than 16 parts only from a file."""
    file.write_text(_hulls_as_obj(parts_m), encoding="ascii")
    shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(file), physicsClientId=world)
    body: int = pybullet.createMultiBody(baseCollisionShapeIndex=shape, physicsClientId=world, **placing)
    pybullet.changeDynamics(
        body,
        -1,
        # Bullet multiplies the frictions of a pair; the root makes the product the specified one.
        lateralFriction=float(np.sqrt(params.friction)),
        restitution=0.0,
        linearDamping=_LINEAR_DAMPING,
        angularDamping=_ANGULAR_DAMPING,
        collisionMargin=_MARGIN_M,
        physicsClientId=world,
    )
    return body


def _hulls_as_obj(parts_m: Sequence[F32]) -> str:
    """OBJ text, one group per part. Bullet makes a hull of each group's corners: faces only list vertices."""
    lines: list[str] = []
    offset = 1
    for k, part in enumerate(parts_m):
        lines.append(f"o part_{k}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in part.tolist()]
        last = offset + len(part) - 1
        lines += [f"f {i} {min(i + 1, last)} {min(i + 2, last)}" for i in range(offset, last + 1, 3)]
        offset = last + 1
    return "\n".join(lines) + "\n"


def _speeds(world: int, bodies: list[int]) -> tuple[float, float]:
    velocities = [pybullet.getBaseVelocity(body, physicsClientId=world) for body in bodies]
    largest = np.linalg.norm(np.array(velocities).reshape(-1, 2, 3), axis=2).max(0, initial=0.0)
    return float(largest[0]), float(largest[1])


def _pose_of(world: int, body: int) -> F64:
    position_m, (x, y, z, w) = pybullet.getBasePositionAndOrientation(body, physicsClientId=world)
    return pose(np.array(position_m), np.array([w, x, y, z]))


def _deepest_contact(world: int) -> float:
    """Depth in metres of the deepest contact point of the last step; 0 when nothing touches."""
    contacts = pybullet.getContactPoints(physicsClientId=world) or ()
    return max(0.0, -min((contact[8] for contact in contacts), default=0.0))


def _xyzw(T: F64) -> list[float]:
    w, x, y, z = quaternion_wxyz(T[:3, :3]).tolist()
    return [x, y, z, w]


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass distribution of a body. The columns of `R_body_principal` are its principal axes."""

    centre_m: F64  # (3,), body frame
    R_body_principal: F64  # (3, 3), a rotation
    inertia_kgm2: F64  # (3,), about the centre of mass along the principal axes


def mass_properties(name: str, parts_m: Sequence[F32], mass_kg: float) -> MassProperties:
    """Properties of convex parts (each (V, 3)) of one density that together weigh `mass_kg`.

    Parts that overlap count twice where they do, as PhysX counts them. Raises InputError, naming
    the body `name` and the part, where a part has no volume.
    """
    volume_m3, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for k, part in enumerate(parts_m):
        points = part.astype(np.float64)
        inside = points.mean(0)
        try:
            hull = ConvexHull(points)
        except QhullError as error:
            fix = "Remove the part or give it thickness"
            raise InputError(name, f"convex_parts_m[{k}]", "has no volume", fix) from error
        corners = points[hull.simplices] - inside  # (T, 3, 3): tetrahedra with `inside` as apex
        v6 = np.abs(np.linalg.det(corners))  # six times each volume
        total = corners.sum(1)
        # Moments of a tetrahedron with one corner at the origin (Tonon 2004, J. Math. Stat. 1:8).
        volume = v6.sum() / 6
        moment = np.einsum("t,ti->i", v6, total) / 24
        outer = np.einsum("t,tki,tkj->ij", v6, corners, corners) + np.einsum("t,ti,tj->ij", v6, total, total)
        volume_m3 += volume
        first += moment + volume * inside
        mixed = np.outer(moment, inside)
        second += outer / 120 + mixed + mixed.T + volume * np.outer(inside, inside)
    if volume_m3 <= 0:
        raise InputError(name, "convex_parts_m", "no part has a volume", "Give the body collision parts")
    density = mass_kg / volume_m3
    centre_m = first / volume_m3
    spread = density * (second - volume_m3 * np.outer(centre_m, centre_m))
    values, axes = np.linalg.eigh(np.trace(spread) * np.eye(3) - spread)
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    return MassProperties(centre_m, axes, values)
