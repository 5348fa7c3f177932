"""One trial's world in SAPIEN's PhysX on the CPU, built for every trial; needs no render device."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.robots.robot import Robot
from datagen.workers.settling.sapien_physics import (
    convex_shape,
    object_body,
    pad_material,
    physx,
    pose_of,
    sapien,
    sapien_pose,
    static_body,
)
from datagen.workers.trials.drive_targets import FINGER_DAMPING, FINGER_STIFFNESS
from datagen.workers.trials.trial_scene import MovingBody, TrialScene, pedestal_below, still_parts_near

# Collision groups [own kinds, kinds to collide with, -, -]: shapes collide where one lists the other's kind.
# Objects collide with everything. The arm collides with objects and static parts, never with itself: the
# planner checks that. Links below the arm collide with objects alone. The shoulder turns on the pedestal and
# does not collide with it.
THING, STILL, PEDESTAL = [1, 1, 0, 0], [4, 1 | 2 | 16, 0, 0], [4, 1 | 2, 0, 0]
ARM, SHOULDER, CARRIER = [2, 1, 0, 0], [16, 1, 0, 0], [8, 1, 0, 0]

# With 15 and 1, the defaults of ManiSkill, more labels depend on the timestep.
POSITION_ITERATIONS, VELOCITY_ITERATIONS = 40, 8
# Iterations of the arm while nothing is within `NEAR_M` of it: its drives alone need no more.
FREE_ITERATIONS, NEAR_M = (4, 1), 0.003
# Contacts are generated up to this distance. PhysX's default is 1 cm.
CONTACT_OFFSET_M = 0.005
SLEEP_THRESHOLD = 0.005  # PhysX's, joules a kilogram
GRAVITY_MPS2 = 9.81  # PhysX's


def still_body(parts_m: Sequence[F32], groups: list[int], friction: float) -> physx.PhysxRigidStaticComponent:
    """A static body of convex parts (V, 3) each in the world frame."""
    body = static_body(parts_m, physx.PhysxMaterial(friction, friction, 0.0))
    for shape in body.get_collision_shapes():
        tune_shape(shape, groups)
    return body


def thing_body(parts_m: Sequence[F32], mass_kg: float, friction: float) -> physx.PhysxRigidDynamicComponent:
    """A movable object of convex parts (V, 3) each in its own frame."""
    body = object_body(parts_m, mass_kg, physx.PhysxMaterial(friction, friction, 0.0))
    for shape in body.get_collision_shapes():
        tune_shape(shape, THING)
    tune_body(body)
    return body


def tune_shape(shape: physx.PhysxCollisionShape, groups: list[int]) -> None:
    """Set the collision groups and contact offset of a shape."""
    shape.set_collision_groups(groups)
    shape.set_contact_offset(CONTACT_OFFSET_M)
    shape.set_rest_offset(0.0)


def tune_pad(shape: physx.PhysxCollisionShape, friction: float, finger_friction: float, pad_m: float) -> None:
    """Give a finger's shape the material of its pad, which is `pad_m` across.

    A soft pad, unlike points, also resists turning about its normal.
    """
    shape.set_physical_material(pad_material(friction, finger_friction))
    shape.set_patch_radius(pad_m / 2)
    shape.set_min_patch_radius(pad_m / 2)


def tune_body(body: physx.PhysxRigidDynamicComponent | physx.PhysxArticulation) -> None:
    """Set solver iterations and sleep threshold of a body."""
    body.set_solver_position_iterations(POSITION_ITERATIONS)
    body.set_solver_velocity_iterations(VELOCITY_ITERATIONS)
    body.set_sleep_threshold(SLEEP_THRESHOLD)


class TrialWorld:
    """Robot, movable objects and static parts, with the steps and measurements that a trial needs.

    Worlds share nothing: in a physics scene that is used again, outcomes depend on what happened in it
    before.
    """

    def __init__(self, scene: TrialScene, T_world_base: F64, opening_m: float, friction: float) -> None:
        robot, bodies, params = scene.robot, scene.articulation_at(opening_m), scene.params
        self._system = _fresh_system()
        self._system.set_timestep(params.timestep_s)
        self._scene = sapien.Scene([self._system])
        self._add(still_body(still_parts_near(scene, T_world_base), STILL, friction))
        if (pedestal_m := pedestal_below(scene, T_world_base)) is not None:
            self._add(still_body([pedestal_m], PEDESTAL, friction))
        self._things = [
            thing_body(parts, float(mass), friction)
            for parts, mass in zip(scene.parts_m, scene.mass_kg, strict=True)
        ]
        for body, T in zip(self._things, scene.T_world_object, strict=True):
            self._add(body, T)
        self._centres = [body.cmass_local_pose for body in self._things]
        links = _robot_links(robot, bodies, friction, params)
        self._links = frozenset(links)
        for link in links:
            self._add(link, T_world_base @ robot.T_base_root if link is links[0] else None)
        self._arm = links[0].articulation
        tune_body(self._arm)
        joints = self._arm.get_active_joints()
        columns = {joint.name: k for k, joint in enumerate(joints)}
        self._columns = np.array([columns[str(k)] for k in range(1, len(bodies))])
        self._coordinates = robot.coordinates
        self._joints = [joints[k] for k in self._columns]
        self._fingers = links[-2:]

    def _add(self, body: sapien.Component, T_world_body: F64 | None = None) -> None:
        entity = sapien.Entity()
        entity.add_component(body)
        if T_world_body is not None:
            entity.set_pose(sapien_pose(T_world_body))
        self._scene.add_entity(entity)

    # -- motion -------------------------------------------------------------------------------------

    def place_arm(self, q_rad: F64, opening_m: float) -> None:
        """Put the arm at joints (A,) at rest, and its drives' targets there."""
        q = np.concatenate([self._coordinates(q_rad), [opening_m / 2] * 2])
        ordered = np.empty(len(q), np.float32)
        ordered[self._columns] = q
        self._arm.set_qpos(ordered)
        self._arm.set_qvel(np.zeros_like(ordered))
        self._set_targets(q.tolist())

    def drive(self, steps: int, start: F64, end: F64, first: int = 0) -> None:
        """Simulate steps `first` to `steps` while the targets (A + 2,) move evenly from `start` to `end`."""
        if np.array_equal(start, end):
            self._drive(end.tolist())
            for _ in range(first, steps):
                self._system.step()
            return
        shares = (np.arange(first + 1, steps + 1) / steps)[:, None]
        for targets in (start + (end - start) * shares).tolist():
            self._drive(targets)
            self._system.step()

    def drive_free(self, steps: int, start: F64, end: F64) -> int:
        """As `drive`, but only until something is near the arm; returns the number of steps taken."""
        shares = (np.arange(1, steps + 1) / steps)[:, None]
        for k, targets in enumerate((start + (end - start) * shares).tolist(), start=1):
            self._drive(targets)
            self._system.step()
            if self.gap_m() < NEAR_M:
                return k
        return steps

    def be_free(self, is_free: bool) -> None:
        """Set whether the arm moves with the few iterations of free motion."""
        iterations = FREE_ITERATIONS if is_free else (POSITION_ITERATIONS, VELOCITY_ITERATIONS)
        self._arm.set_solver_position_iterations(iterations[0])
        self._arm.set_solver_velocity_iterations(iterations[1])

    def look_at(self, q_rad: F64, opening_m: float) -> float:
        """`gap_m` with the arm put at joints (A,); only objects that the arm touches wake up."""
        self.place_arm(q_rad, opening_m)
        self._system.step()
        return self.gap_m()

    def rest(self, rows: Sequence[int]) -> None:
        """Put objects to sleep until something touches them."""
        for k in rows:
            self._things[k].put_to_sleep()

    def _drive(self, targets: list[float]) -> None:
        if not self._coordinates.are_joints:
            q = np.array(targets)
            targets = [*self._coordinates(q[:-2]).tolist(), *targets[-2:]]
        self._set_targets(targets)

    def _set_targets(self, positions: list[float]) -> None:
        for joint, target in zip(self._joints, positions, strict=True):
            joint.set_drive_target(target)

    # -- measurements -------------------------------------------------------------------------------

    @property
    def joints(self) -> F64:
        """Coordinates (A + 2,): the arm's, then the two fingers' in metres."""
        found = np.asarray(self._arm.get_qpos(), np.float64)[self._columns]
        if self._coordinates.are_joints:
            return found
        return np.concatenate([self._coordinates.of_joints(found[:-2]), found[-2:]])

    @property
    def T_world_object(self) -> F64:
        """Poses (K, 4, 4) of the objects."""
        return np.stack([pose_of(body) for body in self._things])

    def positions_m(self) -> F64:
        """Positions (K, 3) of the objects' frames."""
        return np.array([body.entity_pose.p for body in self._things], np.float64)

    def speeds_mps(self) -> F64:
        """Speeds (K,) of the objects."""
        velocities = np.array([body.linear_velocity for body in self._things], np.float64)
        return np.linalg.norm(velocities, axis=1)

    def energies_m(self) -> F64:
        """Potential and kinetic energies (K,) of the objects, as the height that each centre would reach."""
        found: list[float] = []
        for body, centre in zip(self._things, self._centres, strict=True):
            velocity = body.linear_velocity
            height_m = (body.entity_pose * centre).p[2]
            found.append(float(height_m) + float(np.dot(velocity, velocity)) / (2 * GRAVITY_MPS2))
        return np.array(found)

    def gap_m(self) -> float:
        """Smallest gap in the last step between the arm and anything else; inf beyond the contact offset."""
        gap_m = np.inf
        for contact in self._system.get_contacts():
            if contact.bodies[0] in self._links or contact.bodies[1] in self._links:
                gap_m = min([gap_m, *(point.separation for point in contact.points)])
        return gap_m

    def is_supported(self) -> bool:
        """Whether anything but the robot pushed the target in the last step."""
        return any(
            other not in self._links and any(point.impulse.any() for point in points)
            for other, _, points in self._on_target()
        )

    def finger_impulses(self) -> F64:
        """Impulses (2, 3) of the fingers on the target in the last step, newton seconds, world frame."""
        impulses = np.zeros((2, 3))
        for other, sign, points in self._on_target():
            for k, finger in enumerate(self._fingers):
                if other is finger:
                    for point in points:
                        impulses[k] += np.multiply(sign, point.impulse)
        return impulses

    def _on_target(self) -> Iterator[tuple[Any, float, Any]]:
        """Each contact of the target: the other body, the sign of impulses on the target, and the points."""
        for contact in self._system.get_contacts():
            for k, sign in enumerate((1.0, -1.0)):
                if contact.bodies[k] is self._things[0]:
                    yield contact.bodies[1 - k], sign, contact.points


def _fresh_system() -> physx.PhysxCpuSystem:
    """A system with default settings: SAPIEN keeps them per process, where other code may change them."""
    before = physx.get_scene_config()
    physx.set_scene_config(physx.PhysxSceneConfig())  # PhysX's: TGS, PCM, 9.81 m/s^2 down, one thread
    try:
        return physx.PhysxCpuSystem()
    finally:
        physx.set_scene_config(before)


def _robot_links(
    robot: Robot, bodies: Sequence[MovingBody], friction: float, params: TrialParams
) -> list[physx.PhysxArticulationLinkComponent]:
    links: list[physx.PhysxArticulationLinkComponent] = []
    material = physx.PhysxMaterial(friction, friction, 0.0)
    base, drive, count = int(robot.is_base.sum()), robot.drive, len(bodies)
    for k, body in enumerate(bodies):
        is_finger = k >= count - 2
        link = physx.PhysxArticulationLinkComponent(links[body.parent] if body.parent >= 0 else None)
        for part in body.parts_m:
            shape = convex_shape(part, material)
            tune_shape(shape, CARRIER if k < base else SHOULDER if k == base else ARM)
            if is_finger:
                tune_pad(shape, friction, params.finger_friction, sum(robot.gripper.pad_size_m) / 2)
            link.attach(shape)
        if body.mass_kg > 0:  # else as of water: SAPIEN's density of shapes
            link.set_mass(body.mass_kg)
            link.set_cmass_local_pose(sapien_pose(body.T_body_principal))
            link.set_inertia(body.inertia_kgm2.tolist())
        # As in ManiSkill's agents: a real arm's controller compensates its weight.
        link.set_disable_gravity(True)
        joint = link.joint
        if body.parent < 0:
            joint.type = "fixed"
        else:
            joint.name, joint.type = str(k), body.kind  # arm and hand may share names
            joint.set_pose_in_parent(sapien_pose(body.T_parent_joint))
            joint.set_pose_in_child(sapien_pose(body.T_body_joint))
            joint.set_limits([[body.lower, body.upper]])
            if is_finger:
                joint.set_drive_properties(FINGER_STIFFNESS, FINGER_DAMPING, params.grip_force_n, "force")
            elif body.kind == "prismatic":
                damping = drive.slide_stiffness * drive.damping / drive.stiffness
                joint.set_drive_properties(drive.slide_stiffness, damping, drive.slide_force_limit, "force")
            else:
                joint.set_drive_properties(drive.stiffness, drive.damping, drive.force_limit, "force")
        links.append(link)
    return links
