"""Baseline: a band of distances, without the cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from datagen.train.baselines.baseline import RULED_OUT, labels, mount_m, planar_distance_m, reach_m
from datagen.train.inputs import F64, Array, Batch, Bools, is_clear

Kind = Literal["planar", "planar-over-reach", "mount-over-reach"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_EDGES = 101


@dataclass(frozen=True)
class DistanceBand:
    """Positive where low <= d <= high and the base is clear, d being a distance of the heuristic."""

    kind: Kind = "planar"
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
        distances = {kind: np.concatenate([_distance(b, kind) for b in batches]) for kind in KINDS}
        bands = {kind: _best_band(d, label, clear) for kind, d in distances.items()}
        kind = max(KINDS, key=lambda kind: bands[kind][0])
        return replace(self, kind=kind, low=bands[kind][1], high=bands[kind][2])

    def state(self) -> dict[str, Any]:
        return {"kind": self.kind, "low": self.low, "high": self.high}


def _distance(batch: Batch[Array], kind: Kind) -> F64:
    match kind:
        case "planar":
            return planar_distance_m(batch)
        case "planar-over-reach":
            return planar_distance_m(batch) / reach_m(batch)
        case "mount-over-reach":
            return mount_m(batch) / reach_m(batch)


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
