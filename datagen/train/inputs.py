"""Inputs of models, baselines and metrics: clouds, robots and candidates.

Three tables joined by rows, so that a cloud is stored once: a candidate has the row of its robot, and a
robot that of its cloud. Arrays are numpy's as read from a store, or torch's on a model's device
(`to_torch`), with equal shapes, units and frames.

Frame "target": world axes (z up) with the origin at the target's centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError

A = TypeVar("A")  # np.ndarray or torch.Tensor
Array = npt.NDArray[Any]
Bools = npt.NDArray[np.bool_]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Ints = npt.NDArray[np.integer[Any]]
U8 = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Clouds(Generic[A]):
    """S observed scenes of P points each, of which the first `n_points` are valid.

    The first 512 (`observation.n_farthest`) points of a stored cloud are in farthest-point order, so
    that any prefix of them is a farthest-point sample; the rest are in random order.
    """

    points_m: A  # (S, P, 3) float32, target frame
    rgb: A  # (S, P, 3) uint8
    target_mask: A  # (S, P) bool
    n_points: A  # (S,) int64
    target_height_m: A  # (S,) float32, of the target's centre above the floor
    target_radius_m: A  # (S,) float32, of the sphere around its centre that holds the target

    def __len__(self) -> int:
        return len(self.n_points)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class RobotInputs(Generic[A]):
    """R robots, each with the cloud that it is given."""

    cloud_row: A  # (R,) int64, into Clouds
    camera_height_m: A  # (R,) float32, of the robot's own camera above the floor
    base_height_m: A  # (R,) float32, of the arm's mount above the floor
    arm_reach_m: A  # (R,) float32, d_arm
    # (R,) text, always numpy: the robot as `open_robot` accepts it, "" for an unknown one. Robots of one
    # cloud have one name. None: all are unknown.
    name: Array | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.cloud_row)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class CandidateInputs(Generic[A]):
    """N base positions, each of one robot."""

    robot_row: A  # (N,) int64, into Robots
    base_xy_m: A  # (N, 2) float32, target frame
    # (N,) float32: heading from the direction to the target, counter-clockwise. None: bases face the target.
    turn_rad: A | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.robot_row)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Batch(Generic[A]):
    """Candidates with labels. `extra`: further columns with N rows (samples) or S rows (scenes)."""

    clouds: Clouds[A]
    robots: RobotInputs[A]
    candidates: CandidateInputs[A]
    label: A  # (N,) int64, 0 or 1
    sample_id: Array  # (N, 16) uint8, always numpy: names, not numbers
    extra: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.sample_id)


def column(batch: Batch[Array], name: str) -> Array:
    """A further column of the store. InputError where the batch was read without it."""
    if name not in batch.extra:
        raise InputError("batch", name, "was not read", f"Read the batch with extra=({name!r},)")
    return batch.extra[name]


def is_clear(batch: Batch[Array]) -> npt.NDArray[np.bool_]:
    """Mask (N,) of clear bases. InputError where the batch was read without `base_is_clear`."""
    return column(batch, "base_is_clear").astype(np.bool_)
