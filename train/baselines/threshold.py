"""Geometry alone: within reach and clear (the paper's threshold baseline)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from train.baselines.baseline import F64, is_feasible
from train.inputs import Array, Batch


@dataclass(frozen=True)
class Threshold:
    """Score 1 where the base fits and the target is within the arm's reach, else 0."""

    name: str = field(default="threshold", init=False)
    threshold: float = field(default=1.0, init=False)
    needs_fit: bool = field(default=False, init=False)

    def score(self, batch: Batch[Array]) -> F64:
        """1 or 0 (N,)."""
        return is_feasible(batch).astype(float)

    def fit(self, batches: Sequence[Batch[Array]]) -> Threshold:
        return self

    def state(self) -> dict[str, Any]:
        return {}
