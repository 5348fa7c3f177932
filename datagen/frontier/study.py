"""Results from the points of a frontier: learning curves, the worth of stage 1, and purchases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.frontier.buyer import Advice, Target, advise, cheapest
from datagen.frontier.cost_per_label import LabelCost
from datagen.frontier.learning_curves import CurveForm, LearningCurve, fit_curve
from datagen.frontier.mixtures import CHEAP, Mixture
from datagen.frontier.points import METRICS, Point
from datagen.train.evaluation.bootstrap import Estimate, verdict
from datagen.train.inputs import F64

# The metric that purchases are judged by.
JUDGED = METRICS[0]


@dataclass(frozen=True, eq=False)
class Study:
    """Points, and results from them. `joint`: curves of all sources together, by metric."""

    sources: tuple[str, ...]  # the cheap one first, if any
    points: tuple[Point, ...]
    costs: Mapping[str, LabelCost]
    alone: Mapping[tuple[str, str], LearningCurve]  # by source and metric
    joint: Mapping[str, LearningCurve]
    foretold: tuple[Foretold, ...]
    stage1: tuple[StageOneGain, ...]
    stage1_worth: Estimate | None
    advice: Advice | None
    target: Target | None

    @property
    def now(self) -> F64:
        """All labels (K,) of the runs."""
        return np.max([point.quantities(self.sources) for point in self.points], axis=0)


@dataclass(frozen=True, eq=False)
class Foretold:
    """A point with all labels of its last source, measured and predicted by the curve of the smaller ones."""

    name: str
    measured: Estimate
    predicted: Estimate


@dataclass(frozen=True, eq=False)
class StageOneGain:
    """Gain in `JUDGED` by training on all heuristic labels first.

    `same_labels`: over the same dear labels alone. `same_cost`: over as many more dear labels as the
    heuristic ones cost, by the curve of the dear source alone; None without such a curve.
    """

    source: str
    labels: float
    same_labels: Estimate
    same_cost: Estimate | None


def study(
    points: Sequence[Point],
    costs: Mapping[str, LabelCost],
    budget_cpu_h: float,
    target_accuracy: float | None,
) -> Study:
    """Fit the curves and compare purchases."""
    sources = tuple(name for name in costs)
    alone = {
        (source, metric): curve
        for source in sources
        for metric in METRICS
        if (curve := _fitted((source,), _alone(points, source), metric)) is not None
    }
    dear = [point for point in points if point.mixture.stages[-1].source != CHEAP]
    joint = {metric: curve for metric in METRICS if (curve := _fitted(sources, dear, metric)) is not None}
    curve = joint.get(JUDGED)
    now = np.max([point.quantities(sources) for point in points], axis=0)
    return Study(
        sources,
        tuple(points),
        costs,
        alone,
        joint,
        _foretold(sources, dear),
        _stage1_gains(points, costs, alone),
        _stage1_worth(curve, now) if curve else None,
        advise(curve, sources, now, costs, budget_cpu_h) if curve else None,
        cheapest(curve, sources, now, costs, target_accuracy) if curve and target_accuracy else None,
    )


def _alone(points: Sequence[Point], source: str) -> list[Point]:
    return [p for p in points if len(p.mixture.stages) == 1 and p.mixture.stages[0].source == source]


def _fitted(sources: Sequence[str], points: Sequence[Point], metric: str) -> LearningCurve | None:
    """The curve of these points over the labels of these sources."""
    if not points:
        return None
    labels = np.stack([point.quantities(sources) for point in points])  # (M, K)
    cheap = len(sources) > 1 and sources[0] == CHEAP
    largest = labels.max(axis=0)
    form = CurveForm(
        len(sources) - cheap,
        cheap,
        float(largest[cheap:].max()),
        float(max(largest[0], 1.0)) if cheap else 1.0,
    )
    values = np.array([point.values[metric].value for point in points])
    resampled = np.stack([point.values[metric].resamples for point in points], axis=1)
    return fit_curve(form, labels, values, resampled)


def _foretold(sources: Sequence[str], dear: Sequence[Point]) -> tuple[Foretold, ...]:
    """The largest sets, predicted by a curve of the smaller ones."""
    whole = max((point.mixture.stages[-1].share for point in dear), default=0.0)
    smaller = [point for point in dear if point.mixture.stages[-1].share < whole]
    curve = _fitted(sources, smaller, JUDGED)
    if curve is None:
        return ()
    found: list[Foretold] = []
    for point in dear:
        if point.mixture.stages[-1].share == whole:
            predicted, resamples = curve.accuracy(point.quantities(sources))
            name, measured = point.mixture.name, point.values[JUDGED]
            found.append(Foretold(name, measured, Estimate(float(predicted), resamples)))
    return tuple(found)


def _stage1_gains(
    points: Sequence[Point], costs: Mapping[str, LabelCost], alone: Mapping[tuple[str, str], LearningCurve]
) -> tuple[StageOneGain, ...]:
    by_mixture = {point.mixture: point for point in points}
    whole = max(stage.share for point in points for stage in point.mixture.stages)
    found: list[StageOneGain] = []
    for point in points:
        stages = point.mixture.stages
        if len(stages) != 2 or (stages[0].source, stages[0].share) != (CHEAP, whole):
            continue
        source = stages[1].source
        plain = by_mixture[Mixture((stages[1],))]
        gained = point.values[JUDGED]
        same_cost = None
        if (curve := alone.get((source, JUDGED))) is not None:
            for_cheap = point.labels[CHEAP] * costs[CHEAP].cpu_s / costs[source].cpu_s
            both = np.array([[plain.labels[source]], [plain.labels[source] + for_cheap]])
            value, resamples = curve.accuracy(both)
            # The measured point, moved along its curve.
            moved = Estimate(float(value[1] - value[0]), resamples[:, 1] - resamples[:, 0])
            measured = plain.values[JUDGED]
            equal = Estimate(measured.value + moved.value, measured.resamples + moved.resamples)
            same_cost = gained.minus(equal)
        found.append(
            StageOneGain(source, plain.labels[source], gained.minus(plain.values[JUDGED]), same_cost)
        )
    return tuple(found)


def _stage1_worth(curve: LearningCurve, now: F64) -> Estimate | None:
    """Dear labels that all heuristic labels are worth, by the joint curve."""
    if not curve.form.cheap:
        return None
    only_cheap = np.zeros_like(now)
    only_cheap[0] = now[0]
    return Estimate(
        float(curve.form.effective(curve.theta, only_cheap)),
        curve.form.effective(curve.resamples, only_cheap),
    )


def estimate_record(estimate: Estimate) -> dict[str, float | None]:
    """A value with its interval, for JSON."""
    low, high = estimate.interval()
    numbers = {"value": estimate.value, "low": low, "high": high}
    return {name: number if np.isfinite(number) else None for name, number in numbers.items()}


def gain_record(gain: StageOneGain) -> dict[str, Any]:
    """A gain, for JSON."""
    return {
        "source": gain.source,
        "labels": gain.labels,
        "same_labels": {**estimate_record(gain.same_labels), "verdict": verdict(gain.same_labels)},
        "same_cost": gain.same_cost
        and {**estimate_record(gain.same_cost), "verdict": verdict(gain.same_cost)},
    }
