"""Points of a frontier: labels, cost, and accuracy with its bootstrap over seeds and scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.frontier.cost_per_label import LabelCost
from datagen.frontier.mixtures import Mixture
from datagen.frontier.trainings import TrainingResult
from datagen.train.evaluation.bootstrap import (
    Estimate,
    Weights,
    resample_weights,
    resampled_area_under_roc,
    summed,
)
from datagen.train.evaluation.metrics import area_under_roc, balanced_accuracy, confusion
from datagen.train.evaluation.seeds import mean_over_seeds
from datagen.train.inputs import F32, F64, I64, Bools

METRICS = ("balanced_accuracy", "area_under_roc")
_THRESHOLD = 0.5


@dataclass(frozen=True, eq=False)
class TestSet:
    """The test candidates within reach: truth (T,) and scene (T,), numbered without gaps."""

    __test__ = False  # not a test class
    label: Bools
    scene: I64

    @property
    def n_scenes(self) -> int:
        """Scenes with such a candidate."""
        return int(self.scene.max(initial=-1)) + 1


@dataclass(frozen=True, eq=False)
class Point:
    """A mixture, averaged over seeds. Resamples (B,) of all points use the same scenes."""

    mixture: Mixture
    seeds: int
    labels: Mapping[str, float]  # mean over seeds
    cpu_h: float  # of labels
    money: float
    train_cpu_s: float  # of the last stage, mean over seeds
    values: Mapping[str, Estimate]  # of METRICS

    def quantities(self, sources: Sequence[str]) -> F64:
        """Labels (K,) of the sources."""
        return np.array([self.labels.get(source, 0.0) for source in sources])


def points_of(
    results: Mapping[Mixture, Sequence[TrainingResult]],
    test: TestSet,
    costs: Mapping[str, LabelCost],
    n_resamples: int,
    seed: int,
) -> list[Point]:
    """A point for each mixture, from its results of several seeds.

    Scenes are resampled with replacement, together for all; seeds for each mixture.
    """
    rng = np.random.default_rng([seed, test.n_scenes])
    weights = resample_weights(test.n_scenes, n_resamples, rng)
    points: list[Point] = []
    for mixture, of_seeds in results.items():
        n = len(of_seeds)
        drawn = rng.integers(0, n, (n_resamples, n))
        values: dict[str, Estimate] = {}
        for metric in METRICS:
            found = [measured(metric, test, result.scores, weights) for result in of_seeds]
            values[metric] = mean_over_seeds(found, drawn)
        names = {name for result in of_seeds for name in result.labels}
        labels = {name: float(np.mean([r.labels.get(name, 0) for r in of_seeds])) for name in sorted(names)}
        points.append(
            Point(
                mixture,
                n,
                labels,
                sum(costs[name].cpu_s * count for name, count in labels.items()) / 3600,
                sum(costs[name].money * count for name, count in labels.items()),
                float(np.mean([r.record["cost"].get("train_cpu_s", 0.0) for r in of_seeds])),
                values,
            )
        )
    return points


def measured(metric: str, test: TestSet, scores: F32, weights: Weights) -> Estimate:
    """One of METRICS from scores (T,); `weights` (B, S) count the scenes of each resample."""
    score = scores.astype(np.float64)
    if metric == "area_under_roc":
        return Estimate(
            area_under_roc(test.label, score),
            resampled_area_under_roc(weights, test.label, score, test.scene),
        )
    counts = confusion((score >= _THRESHOLD).astype(np.float64), test.label, test.scene, test.n_scenes)
    return Estimate(float(balanced_accuracy(counts.sum(axis=0))), balanced_accuracy(summed(weights, counts)))


def efficient(points: Sequence[Point], metric: str) -> list[bool]:
    """Whether each point is on the frontier: no point costs at most as much and is better."""
    found: list[bool] = []
    for point in points:
        value = point.values[metric].value
        rivals = (p for p in points if p is not point and p.cpu_h <= point.cpu_h)
        found.append(all(rival.values[metric].value < value for rival in rivals))
    return found
