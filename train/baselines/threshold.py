"""Baseline: clear and within reach (the paper's threshold baseline)."""

from __future__ import annotations

from dataclasses import dataclass, field

from datagen.train.baselines.baseline import F64, Unfitted, is_feasible
from datagen.train.inputs import Array, Batch


@dataclass(frozen=True)
class Threshold(Unfitted):
    """Score 1 where the base is clear and the target within the arm's reach, else 0."""

    name: str = field(default="threshold", init=False)
    threshold: float = field(default=1.0, init=False)

    def score(self, batch: Batch[Array]) -> F64:
        """1 or 0 (N,)."""
        return is_feasible(batch).astype(float)
