"""Baselines that are rules on distances, visibility and clearance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from datagen.schemas.specification import DISTANCES, Distance, HeuristicParams
from datagen.train.baselines.baseline import (
    RULED_OUT,
    Unfitted,
    is_feasible,
    labels,
    mount_m,
    observed_rho,
    planar_distance_m,
    reach_m,
    refitted_cut,
)
from datagen.train.inputs import F64, Array, Batch, Bools, is_clear
from datagen.workers.labels.distance_visibility_score import effective_distance, heuristic

_BEST_SHARE, _SHARE_WIDTH = 0.75, 0.1


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


class ReachShare(Unfitted):
    """What an integrator writes in an afternoon: clear, and the mount at 0.75 of the reach from the target.

    The threshold is for 0.65 to 0.85 of the reach.
    """

    name = "reach-share"
    threshold = 0.0

    def score(self, batch: Batch[Array]) -> F64:
        """0.1 - |mount distance / reach - 0.75| (N,), minus `RULED_OUT` where the base is not clear."""
        apart = np.abs(mount_m(batch) / reach_m(batch) - _BEST_SHARE)
        return _SHARE_WIDTH - apart - np.where(is_clear(batch), 0.0, RULED_OUT)


@dataclass(frozen=True)
class ThresholdVisibility:
    """Score: the estimated rho where the base is clear and the target within reach, else -1.

    Positive from `threshold` on, which `fit` sets for the best balanced accuracy of feasible candidates.
    """

    threshold: float = 0.5
    needs_fit = False
    name = "threshold-visibility"

    def score(self, batch: Batch[Array]) -> F64:
        """Estimated rho (N,), and -1 for candidates that are not feasible."""
        return np.where(is_feasible(batch), observed_rho(batch), -1.0)

    def fit(self, batches: Sequence[Batch[Array]]) -> ThresholdVisibility:
        """A copy with the best cut; unchanged where all feasible candidates have the same label."""
        return replace(self, threshold=refitted_cut(self, batches, self.threshold))

    def state(self) -> dict[str, Any]:
        return {"threshold": self.threshold}


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


_EDGES = 101


@dataclass(frozen=True)
class DistanceBand:
    """Positive where low <= d <= high and the base is clear, d being a distance of the heuristic."""

    kind: Distance = "planar"
    low: float = float("nan")
    high: float = float("nan")
    name = "distance"
    threshold = 0.0

    @property
    def needs_fit(self) -> bool:
        return bool(np.isnan(self.low))

    def score(self, batch: Batch[Array]) -> F64:
        """min(d - low, high - d) (N,), minus `RULED_OUT` where the base is not clear."""
        d = _distance(batch, self.kind)
        return np.minimum(d - self.low, self.high - d) - np.where(is_clear(batch), 0.0, RULED_OUT)

    def fit(self, batches: Sequence[Batch[Array]]) -> DistanceBand:
        """The kind and band with the best balanced accuracy; edges are quantiles of d."""
        label = labels(batches, self.name)
        clear = np.concatenate([is_clear(b) for b in batches])
        distances = {kind: np.concatenate([_distance(b, kind) for b in batches]) for kind in DISTANCES}
        bands = {kind: _best_band(d, label, clear) for kind, d in distances.items()}
        kind = max(DISTANCES, key=lambda kind: bands[kind][0])
        return replace(self, kind=kind, low=bands[kind][1], high=bands[kind][2])

    def state(self) -> dict[str, Any]:
        return {"kind": self.kind, "low": self.low, "high": self.high}


def _distance(batch: Batch[Array], kind: Distance) -> F64:
    distances_m = planar_distance_m(batch), mount_m(batch), reach_m(batch)
    return effective_distance(*distances_m, HeuristicParams(distance=kind))


def _best_band(d: F64, label: Bools, clear: Bools) -> tuple[float, float, float]:
    """(balanced accuracy, low, high) of the best band of those between the quantiles of d."""
    edges = np.quantile(d, np.linspace(0, 1, _EDGES))
    inside: list[F64] = []
    for rows in (label & clear, ~label & clear):
        values = np.sort(d[rows])
        from_low, to_high = (np.searchsorted(values, edges, side) for side in ("left", "right"))
        inside.append(np.maximum(to_high[None, :] - from_low[:, None], 0).astype(np.float64))
    sensitivity = inside[0] / label.sum()
    balanced = np.triu(0.5 * (sensitivity + 1 - inside[1] / (~label).sum()))
    low, high = np.unravel_index(int(balanced.argmax()), balanced.shape)
    return float(balanced[low, high]), float(edges[low]), float(edges[high])
