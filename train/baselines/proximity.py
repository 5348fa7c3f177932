"""The closest clear candidate (the paper's proximity baseline)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from datagen.train.baselines.baseline import F64, RULED_OUT, Unfitted, planar_distance_m
from datagen.train.inputs import Array, Batch, is_clear


@dataclass(frozen=True)
class Proximity(Unfitted):
    """Without threshold: the nearest clear one of a robot's candidates is positive, the others negative."""

    name: str = field(default="proximity", init=False)
    threshold: float = field(default=float("nan"), init=False)

    def score(self, batch: Batch[Array]) -> F64:
        """Minus the distance (N,) in metres, minus `RULED_OUT` where the base is not clear."""
        return -planar_distance_m(batch) - np.where(is_clear(batch), 0.0, RULED_OUT)
