"""Methods, their paired differences over the same resampled scenes, and means over seeds of a training.

A paired difference is more precise than the intervals of its two methods: common effects of a scene cancel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from datagen.train.bootstrap import Estimate, verdict
from datagen.train.inputs import F64, I64

# In order of training: the paper compares each with the one before it.
REGIMES = ("stage1", "sim-only", "two-stage")
SEED = 0  # of resamples and arrivals
# By method and metric.
Estimates = Mapping[str, Mapping[str, Estimate]]


@dataclass(frozen=True)
class TrainedBy:
    """Training of a method: regime and model, both "" of a baseline, and the share of the houses used."""

    regime: str = ""
    model: str = ""
    house_share: float = 1.0


NO_TRAINING = TrainedBy()


@dataclass(frozen=True)
class Method:
    """A method: its name among the scores, its threshold and its training.

    `chances` calibrates scores that are no probabilities. Methods with the same `recipe` are trainings that
    differ by their seed alone.
    """

    name: str
    threshold: float
    origin: TrainedBy = NO_TRAINING
    gives_probabilities: bool = False
    chances: Callable[[F64], F64] | None = None
    recipe: str = ""

    @property
    def only_picks(self) -> bool:
        """Whether it has no threshold: only its choice among a robot's candidates is positive."""
        return bool(np.isnan(self.threshold))


def comparisons(
    estimates: Estimates, origins: Mapping[str, TrainedBy], names: Sequence[str]
) -> list[dict[str, Any]]:
    """Differences of every two methods by each metric, with their verdicts, the main ones first.

    Kinds: `regimes`, a regime minus the one before it, of the same model and share of the houses; `best`, the
    best model minus the best baseline, both chosen on these scenes, which the interval does not account for;
    `other`, a model minus a baseline, else in the order of the estimates.
    """
    order = sorted(estimates, key=lambda name: not origins[name].regime)
    found: list[dict[str, Any]] = []
    for metric in names:
        kinds = dict.fromkeys(_consecutive(origins), "regimes")
        kinds |= dict.fromkeys(_best(estimates, origins, metric), "best")
        others = [pair for pair in combinations(order, 2) if pair not in kinds and pair[::-1] not in kinds]
        for (first, second), kind in {**kinds, **dict.fromkeys(others, "other")}.items():
            difference = estimates[first][metric].minus(estimates[second][metric])
            found.append(
                {
                    "kind": kind,
                    "metric": metric,
                    "first": first,
                    "second": second,
                    **difference.values(),
                    "verdict": verdict(difference),
                }
            )
    return found


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


def by_recipe(recipes: Mapping[str, str]) -> dict[str, list[str]]:
    """Names of methods with the same recipe, by the name of their mean; `recipes` has "" for none."""
    alike: dict[str, list[str]] = {}
    for name, recipe in recipes.items():
        if recipe:
            alike.setdefault(recipe, []).append(name)
    return {f"mean of {len(names)} like {names[0]}": names for names in alike.values() if len(names) > 1}


def means_of(
    estimates: Estimates, alike: Mapping[str, Sequence[str]], rng: np.random.Generator
) -> dict[str, dict[str, Estimate]]:
    """The mean over each group of methods, by its name and by metric; seeds are drawn for each group."""
    found: dict[str, dict[str, Estimate]] = {}
    for name, members in alike.items():
        of_seeds = [estimates[member] for member in members]
        n_resamples = len(next(iter(of_seeds[0].values())).resamples)
        drawn = rng.integers(0, len(members), (n_resamples, len(members)))
        found[name] = {
            metric: mean_over_seeds([each[metric] for each in of_seeds], drawn) for metric in of_seeds[0]
        }
    return found


def mean_over_seeds(found: Sequence[Estimate], drawn: I64) -> Estimate:
    """The mean of n seeds; `drawn` (B, n) are the seeds of each resample.

    Resampled means of n seeds vary by a factor sqrt((n - 1) / n) too little, which is corrected. One seed has
    no variance.
    """
    n = len(found)
    resampled = np.stack([estimate.resamples for estimate in found], axis=1)  # (B, n)
    mean = resampled.mean(axis=1)
    spread = np.take_along_axis(resampled, drawn, axis=1).mean(axis=1) - mean
    wider = np.sqrt(n / (n - 1)) if n > 1 else 0.0
    value = float(np.mean([estimate.value for estimate in found]))
    return Estimate(value, mean + wider * spread, found[0].trials)
