"""Baseline: the distance-visibility rule H >= tau with rho estimated from the observed cloud."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from datagen.schemas.specification import HeuristicParams
from datagen.train.baselines.baseline import F64, Unfitted, mount_m, observed_rho, planar_distance_m, reach_m
from datagen.train.inputs import Array, Batch, is_clear
from datagen.workers.labels.distance_visibility_score import heuristic

_PAPER = HeuristicParams()


@dataclass(frozen=True)
class Analytic(Unfitted):
    """Score H (workers/labels/distance_visibility_score.py), positive from tau on.

    `params` are those of a specification, by default the paper's; `datagen calibrate` fits better ones. Where
    the base is not clear the score is H - 10. Without `only_clear` every candidate has score H, as in the
    label source `heuristic`.
    """

    params: HeuristicParams = _PAPER
    only_clear: bool = True

    name: str = field(default="analytic", init=False)

    @property
    def threshold(self) -> float:
        return float(np.float32(self.params.tau))

    def score(self, batch: Batch[Array]) -> F64:
        """H (N,) of the estimated rho."""
        inputs = (planar_distance_m(batch), mount_m(batch), reach_m(batch), observed_rho(batch))
        planar, mount, reach, rho = (a.astype(np.float32) for a in inputs)
        score, _ = heuristic(planar, mount, reach, rho, self.params)
        ruled_out = ~is_clear(batch) if self.only_clear else np.zeros(len(batch), np.bool_)
        return score.astype(np.float64) - np.where(ruled_out, 10.0, 0.0)

    def state(self) -> dict[str, Any]:
        return {"params": self.params.model_dump(mode="json"), "only_clear": self.only_clear}
