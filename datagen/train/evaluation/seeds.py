"""Trainings that differ by their seed alone: their mean, with intervals that hold seeds and scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from datagen.train.evaluation.bootstrap import Estimate
from datagen.train.evaluation.comparisons import Estimates, estimate_values
from datagen.train.inputs import I64


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


def mean_values(means: Estimates, alike: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """The means as JSON values."""
    return [
        {"name": name, "of": list(alike[name]), **{k: estimate_values(e) for k, e in of_metric.items()}}
        for name, of_metric in means.items()
    ]


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
