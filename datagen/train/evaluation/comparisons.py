"""Paired differences of methods over the same resampled scenes, as JSON values.

A paired difference is more precise than the intervals of its two methods: common effects of a scene cancel.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from datagen.train.evaluation.bootstrap import Estimate, are_disjoint, verdict

# In order of training: the paper compares each with the one before it.
REGIMES = ("stage1", "sim-only", "two-stage")
# By method and metric.
Estimates = Mapping[str, Mapping[str, Estimate]]


@dataclass(frozen=True)
class TrainedBy:
    """Training of a method: regime and model, both "" of a baseline, and the share of the houses used."""

    regime: str = ""
    model: str = ""
    house_share: float = 1.0


NO_TRAINING = TrainedBy()


def differences(estimates: Estimates, names: Sequence[str]) -> list[dict[str, Any]]:
    """Difference of every two methods by each metric, its verdict, and whether intervals are disjoint."""
    return [
        _difference(estimates, metric, first, second)
        for metric in names
        for first, second in combinations(estimates, 2)
    ]


def comparisons(
    estimates: Estimates, origins: Mapping[str, TrainedBy], names: Sequence[str]
) -> list[dict[str, Any]]:
    """The main differences, by each metric.

    `regimes`: each regime minus the one before it, of the same model and share of the houses. `best`: the
    best model minus the best baseline, both chosen on these scenes, which the interval does not account for.
    """
    return [
        {"kind": kind, **_difference(estimates, metric, first, second)}
        for metric in names
        for kind, first, second in (
            *(("regimes", later, earlier) for later, earlier in _consecutive(origins)),
            *(("best", *pair) for pair in _best(estimates, origins, metric)),
        )
    ]


def _difference(estimates: Estimates, metric: str, first: str, second: str) -> dict[str, Any]:
    a, b = estimates[first][metric], estimates[second][metric]
    return {
        "metric": metric,
        "first": first,
        "second": second,
        **estimate_values(difference := a.minus(b)),
        "verdict": verdict(difference),
        "disjoint": are_disjoint(a, b),
    }


def _consecutive(origins: Mapping[str, TrainedBy]) -> Iterator[tuple[str, str]]:
    """(later, earlier) names of methods in consecutive regimes of a model and share, the last first."""
    for like in dict.fromkeys(replace(o, regime="") for o in origins.values() if o.regime):
        alike = {r: [n for n, o in origins.items() if o == replace(like, regime=r)] for r in REGIMES}
        present = [names for names in alike.values() if names]
        for earlier, later in reversed(list(pairwise(present))):
            yield from ((a, b) for a in later for b in earlier)


def _best(estimates: Estimates, origins: Mapping[str, TrainedBy], metric: str) -> Iterator[tuple[str, str]]:
    """(best model, best baseline) where there are both; the first of equals."""
    known = {n: e[metric].value for n, e in estimates.items() if np.isfinite(e[metric].value)}
    models, baselines = ([n for n in known if bool(origins[n].regime) is side] for side in (True, False))
    if models and baselines:
        yield max(models, key=known.__getitem__), max(baselines, key=known.__getitem__)


def estimate_values(estimate: Estimate) -> dict[str, float | None]:
    """Value and interval as JSON values."""
    low, high = estimate.interval()
    return {"value": finite(estimate.value), "low": finite(low), "high": finite(high)}


def finite(value: float) -> float | None:
    """None for nan."""
    return value if np.isfinite(value) else None
