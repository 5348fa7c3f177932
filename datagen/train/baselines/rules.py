"""Baselines that are rules with given numbers: proximity, threshold (both of the paper), and analytic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.schemas.specification import HeuristicParams
from datagen.train.baselines.baseline import (
    RULED_OUT,
    Unfitted,
    is_feasible,
    mount_m,
    observed_rho,
    planar_distance_m,
    reach_m,
)
from datagen.train.inputs import F64, Array, Batch, is_clear
from datagen.workers.labels.distance_visibility_score import heuristic


class Proximity(Unfitted):
    """Without threshold: a robot's nearest clear candidate is positive, its others are negative."""

    name = "proximity"
    threshold = float("nan")

    def score(self, batch: Batch[Array]) -> F64:
        """Minus the distance (N,) in metres, minus `RULED_OUT` where the base is not clear."""
        return -planar_distance_m(batch) - np.where(is_clear(batch), 0.0, RULED_OUT)


class Threshold(Unfitted):
    """Score 1 where the base is clear and the target within the arm's reach, else 0."""

    name = "threshold"
    threshold = 1.0

    def score(self, batch: Batch[Array]) -> F64:
        """1 or 0 (N,)."""
        return is_feasible(batch).astype(float)


_PAPER = HeuristicParams()


@dataclass(frozen=True)
class Analytic(Unfitted):
    """Score H (workers/labels/distance_visibility_score.py) with the estimated rho, positive from tau on.

    `params` are by default the paper's; `datagen calibrate` fits better ones. Where the base is not clear
    the score is H - 10. Without `only_clear` every candidate has score H, as in the label source `heuristic`.
    """

    params: HeuristicParams = _PAPER
    only_clear: bool = True
    name = "analytic"

    @property
    def threshold(self) -> float:
        return float(np.float32(self.params.tau))

    def score(self, batch: Batch[Array]) -> F64:
        """H (N,) of the estimated rho."""
        inputs = (planar_distance_m(batch), mount_m(batch), reach_m(batch), observed_rho(batch))
        planar, mount, reach, rho = (a.astype(np.float32) for a in inputs)
        score, _ = heuristic(planar, mount, reach, rho, self.params)
        ruled_out = ~is_clear(batch) if self.only_clear else False
        return score.astype(np.float64) - np.where(ruled_out, 10.0, 0.0)

    def state(self) -> dict[str, Any]:
        return {"params": self.params.model_dump(mode="json"), "only_clear": self.only_clear}
