"""Physics until rest. SETTLERS is the registry; each engine lives in one file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from datagen.schemas.errors import InputError
from datagen.schemas.specification import SettleParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects.model import ObjectModel
from datagen.workers.registry import can_import, entry


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


class Settler(Protocol):
    """Lets objects fall onto static convex parts, in a fresh physics scene, deterministically."""

    def __call__(
        self,
        static_parts_m: Sequence[F32],  # each (V, 3), world frame
        objects: Sequence[ObjectModel],
        T_world_object: F64,  # (K, 4, 4), start poses
        params: SettleParams,
    ) -> SettleResult: ...


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
    for name in SETTLERS:
        if can_import(SETTLERS, name):
            return name
    raise InputError("settle.engine", "", "none can be imported here", "Run `datagen doctor`")
