"""Trials: planned grasps executed in physics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.workers.geometry.mesh import F64


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Differences of the world from the planned one."""

    T_target_moved: F64  # (4, 4), the target's true pose in its planned frame: T_true = T_planned @ this
    T_base_moved: F64  # (4, 4), the base's true pose in its planned frame
    object_friction: float
    mass_scale: float

    @staticmethod
    def none(object_friction: float) -> Disturbance:
        """The world as planned."""
        return Disturbance(np.eye(4), np.eye(4), object_friction, 1.0)


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses over a trial, for pictures: T moments, A joints, K objects."""

    time_s: F64  # (T,)
    q_rad: F64  # (T, A)
    opening_m: F64  # (T,)
    T_world_object: F64  # (T, K, 4, 4)
    phase: tuple[str, ...]  # (T,), reach, approach, close, lift or hold


@dataclass(frozen=True, eq=False)
class TrialResult:
    """`outcome` is a key of OUTCOMES that stage `execute` decides."""

    outcome: str
    lift_m: float  # rise of the target at the grasp from the end of closing on; before it, of its frame
    slip_m: float  # motion of the target at the grasp, relative to the hand, from the end of closing on
    disturbed_m: float  # largest motion of any other object
    simulated_s: float
    recording: Recording | None = None
