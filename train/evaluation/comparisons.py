"""Methods beside each other: differences over the same resampled scenes, as JSON has them.

A difference is sharper than the intervals of its two methods: what a scene adds to both falls out of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from train.evaluation.bootstrap import Estimate, are_disjoint, verdict

# As they build on each other; what the paper asks is what each adds to the one before it.
REGIMES = ("stage1", "sim-only", "two-stage")
# By method and metric.
Estimates = Mapping[str, Mapping[str, Estimate]]


@dataclass(frozen=True)
class Origin:
    """What trained a method: regime and model, both "" of a baseline."""

    regime: str = ""
    model: str = ""


NO_TRAINING = Origin()


def differences(estimates: Estimates, names: Sequence[str]) -> list[dict[str, Any]]:
    """Every two methods by each metric: the difference, what can be said of it, and of the two intervals."""
    return [
        _difference(estimates, metric, first, second)
        for metric in names
        for first, second in combinations(estimates, 2)
    ]


def comparisons(
    estimates: Estimates, origins: Mapping[str, Origin], names: Sequence[str]
) -> list[dict[str, Any]]:
    """The differences that are asked for first, by each metric.

    `regimes`: each regime less the one before it, of the same model. `best`: the best model less the best
    baseline, both chosen by these very scenes, which no interval allows for.
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
        **said_of(difference := a.minus(b)),
        "verdict": verdict(difference),
        "disjoint": are_disjoint(a, b),
    }


def _consecutive(origins: Mapping[str, Origin]) -> Iterator[tuple[str, str]]:
    """(later, earlier) of each model's regimes that are there, the last first."""
    for model in dict.fromkeys(o.model for o in origins.values() if o.regime):
        present = [r for r in REGIMES if Origin(r, model) in origins.values()]
        for earlier, later in reversed(list(pairwise(present))):
            by_regime = {
                r: [n for n, o in origins.items() if o == Origin(r, model)] for r in (earlier, later)
            }
            yield from ((a, b) for a in by_regime[later] for b in by_regime[earlier])


def _best(estimates: Estimates, origins: Mapping[str, Origin], metric: str) -> Iterator[tuple[str, str]]:
    """(best model, best baseline) where there are both; the first named of equals."""
    known = {n: e[metric].value for n, e in estimates.items() if np.isfinite(e[metric].value)}
    models, baselines = ([n for n in known if bool(origins[n].regime) is side] for side in (True, False))
    if models and baselines:
        yield max(models, key=known.__getitem__), max(baselines, key=known.__getitem__)


def said_of(estimate: Estimate) -> dict[str, float | None]:
    """Value and interval as JSON has them."""
    low, high = estimate.interval()
    return {"value": finite(estimate.value), "low": finite(low), "high": finite(high)}


def finite(value: float) -> float | None:
    """None for what no number says."""
    return value if np.isfinite(value) else None
