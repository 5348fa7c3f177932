"""Score grasps: a floating hand closes on the object, which is then pulled, in SAPIEN's PhysX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import inverse, rotation_of, translation
from datagen.workers.robots.gripper import Gripper
from datagen.workers.settling.sapien_physics import (
    add_object,
    convex_shape,
    pad_material,
    physx,
    sapien,
    sapien_pose,
)

Bools = npt.NDArray[np.bool_]

_GRAVITY_MPS2 = 9.81
# A finger's joint: its x axis, along which it moves, is the hand's y for finger 0 and -y for finger 1.
_JOINT_AXES = (np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
_NO_TORQUE = [0.0, 0.0, 0.0]
# Fingers that turn slide here, in one posture, so that their roots would meet before their pads do.
_NOT_ITSELF = [2, 1, 0, 0]  # SAPIEN's collision groups: this hand touches the object alone
_FINGER_MASS_KG = 0.05
_FINGER_INERTIA_KGM2 = 1e-4


@dataclass(frozen=True)
class HandTest:
    """Parameters of a trial: a fixed hand closes without gravity, then the object is pulled each way.

    In the hand's frame a lift is a pull: gravity and the acceleration of the lift. The object's pose has a
    normal error, as with an arm.
    """

    grip_force_n: float = 40.0  # each finger
    closing_mps: float = 0.1  # each finger
    object_friction: float = 0.6
    finger_friction: float = 2.0
    close_s: float = 0.2
    pull_s: float = 0.15  # each pull
    pull_mps2: float = 1.25 * _GRAVITY_MPS2
    max_slip_m: float = 0.03
    position_error_m: float = 0.002
    turn_error_rad: float = 0.035
    timestep_s: float = 1 / 240
    # With 10, flat cans slip from grasps that hold with more: the test of real flat objects fails.
    position_iterations: int = 20
    velocity_iterations: int = 2
    contact_offset_m: float = 0.002
    hands_at_once: int = 32


# Down for an object that stands upright, out of the hand, and along its pads.
PULLS = ("down", "out", "across")


def held_trials(
    parts_m: Sequence[F32],
    mass_kg: float,
    gripper: Gripper,
    T_object_tcp: F64,
    opening_m: F64,
    rng: np.random.Generator,
    test: HandTest,
) -> Bools:
    """Whether the grasps (N, 4, 4) hold the object in each of `PULLS`; (N, 3).

    A hand closes once, and the pulls follow each other. Held means that the object's frame moves by less than
    `max_slip_m` in the hand during the pull. Poses that are not finite count as not held. Hands share scenes,
    too far apart to touch each other: the first n of N grasps have the same results as n grasps alone.
    """
    n = len(T_object_tcp)
    held = np.zeros((n, len(PULLS)), bool)
    errors = [_error(rng, test) for _ in range(n)]
    T_tcp_object = np.array([inverse(T) @ error for T, error in zip(T_object_tcp, errors, strict=True)])
    T_tcp_object = T_tcp_object.reshape(n, 4, 4)
    pulls_mps2 = np.stack([_pull_directions(name, T_object_tcp) * test.pull_mps2 for name in PULLS])
    for start in range(0, n, test.hands_at_once):
        some = slice(start, start + test.hands_at_once)
        slips_m = _slips(
            parts_m, mass_kg, gripper, T_tcp_object[some], opening_m[some], pulls_mps2[:, some], test
        )
        held[some] = slips_m < test.max_slip_m
    return held


def _pull_directions(name: str, T_object_tcp: F64) -> F64:
    """Unit directions (N, 3) in the TCP frame."""
    n = len(T_object_tcp)
    if name == "down":
        return -T_object_tcp[:, 2, :3]
    if name == "out":
        return np.tile([0.0, 0.0, 1.0], (n, 1))
    return np.where(np.arange(n) % 2 == 0, 1.0, -1.0)[:, None] * np.array([1.0, 0.0, 0.0])


def _error(rng: np.random.Generator, test: HandTest) -> F64:
    """A small motion (4, 4) of the object."""
    T = translation(*(test.position_error_m * rng.standard_normal(3)).tolist())
    half = test.turn_error_rad / 2 * rng.standard_normal(3)
    T[:3, :3] = rotation_of(np.array([1.0, *half]))
    return T


def _slips(
    parts_m: Sequence[F32],
    mass_kg: float,
    gripper: Gripper,
    T_tcp_object: F64,
    opening_m: F64,
    pulls_mps2: F64,
    test: HandTest,
) -> F64:
    """Distances (N, K), metres, that the objects move in each pull (K, N, 3); inf where not finite."""
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    scene.set_timestep(test.timestep_s)
    rubber = pad_material(test.object_friction, test.finger_friction)
    skin = physx.PhysxMaterial(test.object_friction, test.object_friction, 0.0)
    n = len(T_tcp_object)
    across = int(np.ceil(np.sqrt(n)))
    largest_m = max(float(np.linalg.norm(part, axis=1).max()) for part in parts_m)
    spacing_m = 1.0 + 2 * largest_m
    bodies: list[physx.PhysxRigidDynamicComponent] = []
    for k in range(n):
        T_world_tcp = translation(spacing_m * (k % across), spacing_m * (k // across), 0.0)
        _add_hand(scene, gripper, T_world_tcp, float(opening_m[k]), rubber, test)
        body = add_object(scene, parts_m, mass_kg, T_world_tcp @ T_tcp_object[k], skin)
        _tune(body, test)
        bodies.append(body)
    for _ in range(round(test.close_s / test.timestep_s)):
        scene.step()
    slips_m: list[F64] = []
    for pull_mps2 in pulls_mps2:
        before_m = _positions(bodies)
        forces_n = (mass_kg * pull_mps2).astype(np.float32)
        for _ in range(round(test.pull_s / test.timestep_s)):
            for body, force_n in zip(bodies, forces_n, strict=True):
                body.add_force_torque(force_n, _NO_TORQUE)
            scene.step()
        slips_m.append(np.linalg.norm(_positions(bodies) - before_m, axis=1))
    slip_m = np.stack(slips_m, axis=1)
    return np.where(np.isfinite(slip_m), slip_m, np.inf)


def _positions(bodies: Sequence[physx.PhysxRigidDynamicComponent]) -> F64:
    return np.array([body.entity.pose.p for body in bodies], np.float64).reshape(-1, 3)


def _add_hand(
    scene: sapien.Scene,
    gripper: Gripper,
    T_world_tcp: F64,
    opening_m: float,
    rubber: physx.PhysxMaterial,
    test: HandTest,
) -> None:
    """Add a hand with a fixed palm and fingers `opening_m` apart that close.

    It is an articulation, because free bodies on drives hold almost nothing. A finger is driven by force =
    damping x (target speed - speed), with no spring: a blocked finger pushes with exactly `grip_force_n`. An
    object off the middle is not carried away, as in a hand whose fingers are coupled.
    """
    builder = scene.create_articulation_builder()
    palm = builder.create_link_builder()
    for axes in _JOINT_AXES:
        finger = builder.create_link_builder(palm)
        T = np.eye(4)
        T[:3, :3] = axes
        finger.set_joint_properties(
            "prismatic", [[0.0, gripper.max_opening_m / 2]], sapien_pose(T), sapien_pose(T)
        )
    hand = builder.build(fix_root_link=True)
    parts_m = (gripper.palm_parts_m, *gripper.fingers_near(opening_m))
    for link, parts in zip(hand.links, parts_m, strict=True):
        for part in parts:
            shape = convex_shape(part, rubber)
            if gripper.linkage is not None:
                shape.set_collision_groups(_NOT_ITSELF)
            link.attach(shape)
        _tune(link, test)
    for finger in hand.links[1:]:
        finger.set_mass(_FINGER_MASS_KG)
        finger.set_inertia([_FINGER_INERTIA_KGM2] * 3)
    hand.set_solver_position_iterations(test.position_iterations)
    hand.set_solver_velocity_iterations(test.velocity_iterations)
    hand.set_root_pose(sapien_pose(T_world_tcp))
    hand.set_qpos(np.full(2, opening_m / 2, np.float32))
    for joint in hand.active_joints:
        joint.set_friction(0.0)
        joint.set_drive_properties(0.0, test.grip_force_n / test.closing_mps)
        joint.set_drive_velocity_target(-test.closing_mps)


def _tune(body: physx.PhysxRigidBodyComponent, test: HandTest) -> None:
    body.set_disable_gravity(True)
    for shape in body.collision_shapes:
        # The default, 1 cm, makes contacts with everything near a finger.
        shape.set_contact_offset(test.contact_offset_m)
    if isinstance(body, physx.PhysxRigidDynamicComponent):
        body.set_solver_position_iterations(test.position_iterations)
        body.set_solver_velocity_iterations(test.velocity_iterations)
        body.set_sleep_threshold(0.0)
