"""Accuracy, balanced accuracy and Cohen's kappa of labels, with intervals from resampled scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.train.bootstrap import LEVEL, Estimate, resample_weights, summed
from datagen.train.inputs import F64, Bools, Ints
from datagen.train.metrics import accuracy, balanced_accuracy, confusion, ratio

RESAMPLES = 1000
_BLOCK = 100  # resamples at a time, which bounds memory

METHOD = f"{RESAMPLES} resamples of scenes, {100 * LEVEL:g}% percentile intervals"


def cohen_kappa(counts: F64) -> F64:
    """Cohen's kappa (...) of confusions (..., 4): agreement beyond chance; nan where chance is 1.

    (p - e) / (1 - e) with p the share of equal labels and e the share expected of two independent raters with
    the same margins (Cohen 1960, "A coefficient of agreement for nominal scales").
    """
    tp, fp, fn, tn = np.moveaxis(counts, -1, 0)
    n = tp + fp + fn + tn
    chance = ratio((tp + fp) * (tp + fn) + (fn + tn) * (fp + tn), n * n)
    return ratio(accuracy(counts) - chance, 1 - chance)


METRICS: dict[str, Callable[[F64], F64]] = {
    "accuracy": accuracy,
    "balanced_accuracy": balanced_accuracy,
    "kappa": cohen_kappa,
}


def estimates_by_group(
    predicted: Bools, true: Bools, scene: npt.NDArray[np.integer[Any]], group: Ints, n_groups: int
) -> list[dict[str, Any]]:
    """For each group: count, scenes, and each of METRICS with its interval (`accuracy_interval`).

    Arguments are (N,); `group` is in [0, n_groups). A metric is None where it is undefined, an interval also
    where the group has fewer than two scenes. The same resamples of scenes serve all groups.
    """
    _, scene_row = np.unique(scene, return_inverse=True)
    n_scenes = int(scene_row.max(initial=-1)) + 1
    cells = confusion(predicted.astype(np.float64), true, scene_row * n_groups + group, n_scenes * n_groups)
    per_scene = cells.reshape(n_scenes, n_groups, 4)
    resampled = _resampled(per_scene)
    whole, scenes = per_scene.sum(axis=0), (per_scene.sum(axis=2) > 0).sum(axis=0)
    return [
        {"count": int(whole[g].sum()), "scenes": int(scenes[g])}
        | _estimates(whole[g], resampled[:, g], int(scenes[g]))
        for g in range(n_groups)
    ]


def _resampled(per_scene: F64) -> F64:
    """Confusions (B, G, 4) of RESAMPLES draws of scenes, from those of each scene (S, G, 4)."""
    n_scenes, n_groups, _ = per_scene.shape
    flat = per_scene.reshape(n_scenes, n_groups * 4)
    if not n_scenes:
        return np.zeros((0, n_groups, 4))
    rng = np.random.default_rng([0, n_scenes])  # as evaluations draw them: the same for the same scenes
    blocks = [summed(resample_weights(n_scenes, _BLOCK, rng), flat) for _ in range(RESAMPLES // _BLOCK)]
    return np.concatenate(blocks).reshape(RESAMPLES, n_groups, 4)


def _estimates(whole: F64, resampled: F64, scenes: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, metric in METRICS.items():
        # The exact interval of shares that are 0 or 1 everywhere holds for independent trials: scenes.
        trials = scenes if name == "accuracy" else 0
        estimate = Estimate(float(metric(whole)), metric(resampled), trials)
        found[name] = finite(estimate.value)
        interval = [finite(bound) for bound in estimate.interval()] if scenes > 1 else [None]
        found[f"{name}_interval"] = None if None in interval else interval
    return found


def finite(value: float) -> float | None:
    """The number; None where it is nan or infinite, which JSON does not have."""
    return value if math.isfinite(value) else None


def codes_of(values: Sequence[Any] | npt.NDArray[Any]) -> tuple[list[str], Ints]:
    """Distinct values as sorted text, and the index (N,) of each value among them."""
    names, codes = np.unique(np.asarray(values).astype(str), return_inverse=True)
    return [str(name) for name in names], codes
