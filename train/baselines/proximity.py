"""The closest clear candidate (the paper's proximity baseline)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from train.baselines.baseline import F64, RULED_OUT, planar_distance_m
from train.inputs import Array, Batch, is_clear


@dataclass(frozen=True)
class Proximity:
    """It only picks: the nearest clear one of a robot's candidates is good, and all others are bad."""

    name: str = field(default="proximity", init=False)
    threshold: float = field(default=float("nan"), init=False)
    needs_fit: bool = field(default=False, init=False)

    def score(self, batch: Batch[Array]) -> F64:
        """Minus the distance (N,) in metres, less `RULED_OUT` where the base does not fit."""
        return -planar_distance_m(batch) - np.where(is_clear(batch), 0.0, RULED_OUT)

    def fit(self, batches: Sequence[Batch[Array]]) -> Proximity:
        return self

    def state(self) -> dict[str, Any]:
        return {}
