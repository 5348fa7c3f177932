"""The interface of settlers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from datagen.schemas.specification import SettleParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects.model import ObjectModel


@dataclass(frozen=True, eq=False)
class SettleResult:
    """Final poses of the objects and their motion at the end.

    `penetration_m` is the depth of the deepest contact at the end, `residual_*` the largest
    speeds then. `at_rest` is True if they stayed below the limits for `rest_steps` steps.
    Poses may hold NaN if the physics became unstable; callers must check.
    """

    T_world_object: F64  # (K, 4, 4)
    steps: int
    at_rest: bool
    residual_speed_mps: float
    residual_angular_radps: float
    penetration_m: float


class Settler(Protocol):
    """Lets objects fall onto static convex parts, in a fresh physics scene, deterministically."""

    def __call__(
        self,
        static_parts_m: Sequence[F32],  # each (V, 3), world frame
        objects: Sequence[ObjectModel],
        T_world_object: F64,  # (K, 4, 4), start poses
        params: SettleParams,
    ) -> SettleResult: ...
