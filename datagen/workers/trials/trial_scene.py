"""Geometry shared by all trials of one robot in one scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.objects.part_merging import merge_parts
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes.scene import SettledScene
from datagen.workers.trials.articulation import Articulation, articulation_of
from datagen.workers.trials.trial import Disturbance

# Static parts up to this far beyond the arm's reach take part: knocked over objects can hit them.
_BEYOND_REACH_M = 0.4
_PEDESTAL_SIDES = 16
_PEDESTAL_GAP_M = 0.005  # below the mount, so that the arm's own foot does not touch it
_MOVED_ABOVE_M = 0.0005  # a moved target starts this far above its support


@dataclass(frozen=True, eq=False)
class MovableObjects:
    """The movable objects of a trial: object 0 is the target."""

    parts_m: tuple[tuple[F32, ...], ...]  # (K,) convex parts each, object frames
    mass_kg: F64  # (K,)
    T_world_object: F64  # (K, 4, 4)


@dataclass(frozen=True, eq=False)
class TrialScene:
    """A scene and a robot, ready for any number of trials."""

    robot: Robot
    articulation: Articulation
    params: TrialParams
    base_radius_m: float
    still_parts_m: tuple[F32, ...]  # each (V, 3), world frame
    still_low_m: F64  # (S, 3) corners of the parts' bounding boxes
    still_high_m: F64
    parts_m: tuple[tuple[F32, ...], ...]  # (K,) of the objects, merged
    mass_kg: F64  # (K,)
    T_world_object: F64  # (K, 4, 4)


def prepare_trials(
    scene: SettledScene, robot: Robot, params: TrialParams, base_radius_m: float
) -> TrialScene:
    """Geometry of a scene and a robot, ready for any number of trials.

    `base_radius_m` is that of the pedestal, for robots without a base of their own. Raises InputError
    where the robot's URDF cannot be used.
    """
    still = tuple(part for body in scene.house.house.bodies for part in body.convex_parts_m)
    low = np.array([part.min(axis=0) for part in still], np.float64).reshape(-1, 3)
    high = np.array([part.max(axis=0) for part in still], np.float64).reshape(-1, 3)
    return TrialScene(
        robot=robot,
        articulation=articulation_of(robot),
        params=params,
        base_radius_m=base_radius_m,
        still_parts_m=still,
        still_low_m=low,
        still_high_m=high,
        parts_m=tuple(merge_parts(model.convex_parts_m, params.hulls_per_object) for model in scene.models),
        mass_kg=np.array([model.mass_kg for model in scene.models]),
        T_world_object=scene.T_world_object,
    )


def still_parts_near(prepared: TrialScene, T_world_base: F64) -> list[F32]:
    """Static parts (V, 3) near the arm: at its sides, above it and below it, since objects fall on floors."""
    reach_m = prepared.robot.reach_m + _BEYOND_REACH_M
    x, y, z = T_world_base[:3, 3]
    apart = np.maximum(0.0, np.maximum(prepared.still_low_m - [x, y, z], [x, y, z] - prepared.still_high_m))
    near = (np.hypot(apart[:, 0], apart[:, 1]) <= reach_m) & (prepared.still_low_m[:, 2] <= z + reach_m)
    return [prepared.still_parts_m[k] for k in np.flatnonzero(near)]


def pedestal_below(prepared: TrialScene, T_world_base: F64) -> F32 | None:
    """Corners (V, 3) of the pedestal below the mount; None for robots with their own base."""
    if prepared.robot.base_radius_m is not None:
        return None
    x, y, z = T_world_base[:3, 3]
    angles = 2 * np.pi * np.arange(_PEDESTAL_SIDES) / _PEDESTAL_SIDES
    ring = np.array([x, y]) + prepared.base_radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    levels = (0.0, z - _PEDESTAL_GAP_M)
    return np.concatenate([np.c_[ring, np.full(_PEDESTAL_SIDES, level)] for level in levels]).astype(
        np.float32
    )


def disturbed_things(prepared: TrialScene, disturbance: Disturbance) -> MovableObjects:
    """The movable objects with the disturbance applied."""
    mass_kg, T_world_object = prepared.mass_kg.copy(), prepared.T_world_object.copy()
    mass_kg[0] *= disturbance.mass_scale
    T_world_object[0] = _moved_target(prepared, disturbance.T_target_moved)
    return MovableObjects(prepared.parts_m, mass_kg, T_world_object)


def _moved_target(prepared: TrialScene, T_target_moved: F64) -> F64:
    """The target's true pose (4, 4), raised where its lowest point would be below the planned one."""
    T_planned = prepared.T_world_object[0]
    T = T_planned @ T_target_moved
    if np.array_equal(T_target_moved, np.eye(4)):
        return T
    corners = np.concatenate(prepared.parts_m[0]).astype(np.float64)
    lowest, was = (corners @ M[2, :3] + M[2, 3] for M in (T, T_planned))
    return translation(0.0, 0.0, max(0.0, was.min() - lowest.min()) + _MOVED_ABOVE_M) @ T
