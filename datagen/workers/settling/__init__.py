"""Physics until rest. SETTLERS is the registry; each engine lives in one file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.specification import SettleParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects.model import ObjectModel
from datagen.workers.registry import entry


@dataclass(frozen=True, eq=False)
class SettleResult:
    """Final poses of the objects and their motion at the end.

    `penetration_m` is the depth of the deepest contact at the end, `residual_speed_mps` the largest
    speed then. `at_rest` is True if they stayed below the limits for `rest_steps` steps.
    Poses may hold NaN if the physics became unstable; callers must check.
    """

    T_world_object: F64  # (K, 4, 4)
    steps: int
    at_rest: bool
    residual_speed_mps: float
    penetration_m: float


# Lets objects fall onto static convex parts (V, 3) each, in a fresh physics scene, deterministically; parts
# and start poses (K, 4, 4) are in the world frame.
Settler = Callable[[Sequence[F32], Sequence[ObjectModel], F64, SettleParams], SettleResult]

_CHECK_EVERY = 5  # steps between checks of the speeds: reading them costs as much as a step


def fall(
    step: Callable[[], object], speeds: Callable[[], tuple[float, float]], params: SettleParams
) -> tuple[int, bool, float]:
    """Step until rest; return steps, whether at rest, and the largest speed at the end (m/s).

    `speeds` returns the largest speed (m/s) and angular speed (rad/s) of the objects.
    """
    steps, resting, speed = 0, 0, np.inf
    while steps < params.max_steps and resting < params.rest_steps:
        for _ in range(min(_CHECK_EVERY, params.max_steps - steps)):
            step()
            steps += 1
        speed, angular = speeds()
        if not (np.isfinite(speed) and np.isfinite(angular)):
            break
        calm = speed < params.rest_speed_mps and angular < params.rest_angular_speed_radps
        resting = resting + _CHECK_EVERY if calm else 0
    return steps, resting >= params.rest_steps, speed


SETTLERS: dict[str, str] = {
    "sapien": "datagen.workers.settling.sapien_physics:settle_sapien",
    "pybullet": "datagen.workers.settling.pybullet_settler:settle_pybullet",
}


def load_settler(name: str) -> Settler:
    """The settler of that name. Raises InputError where it is unknown or cannot be imported."""
    settler: Settler = entry(SETTLERS, name, "settle.engine")
    return settler


def first_settler() -> str:
    """The first settler of the registry that can be imported here."""
    for name, target in SETTLERS.items():
        with suppress(ImportError):
            import_module(target.partition(":")[0])
            return name
    raise InputError("settle.engine", "", "none can be imported here", "Run `datagen doctor`")
