"""Fit the distance-visibility rule to labels of grasp trials: the parameters that the paper does not give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import differential_evolution

from datagen.schemas.errors import InputError
from datagen.schemas.specification import Distance, HeuristicParams
from datagen.train.bootstrap import Estimate, resample_weights, summed
from datagen.train.inputs import F32, F64, I64, Array, Bools
from datagen.train.metrics import accuracy, balanced_accuracy, confusion
from datagen.workers.labels.distance_visibility_score import effective_distance, heuristic, visibility_score

FOLDS = 5
# Fewer scenes give no meaningful interval.
MIN_SCENES = 10
RESAMPLES = 1000
# Decimals of parameters: a tenth of a millimetre.
_DECIMALS = 4
_FITTED = ("mu", "sigma_l", "sigma_r", "tau")
_SIGMAS = (0.01, 2.0)
_POPULATION, _GENERATIONS = 60, 100


@dataclass(frozen=True, eq=False)
class Trials:
    """N labelled candidates of S scenes, each with at least one."""

    scene: I64  # (N,) into `house`
    house: Array  # (S,) text
    distance_m: F32  # (N,)
    mount_distance_m: F32  # (N,)
    arm_reach_m: F32  # (N,)
    visibility: F32  # (N,)
    label: Bools  # (N,)

    def __len__(self) -> int:
        return len(self.label)

    def at(self, rows: Bools) -> Trials:
        """Some of the candidates (N,), with the scenes that they belong to."""
        scenes, scene = np.unique(self.scene[rows], return_inverse=True)
        cut = {f.name: getattr(self, f.name)[rows] for f in fields(self)[2:]}
        return Trials(scene, self.house[scenes], **cut)

    def labels_by(self, params: HeuristicParams) -> Bools:
        """The rule's labels (N,), by the code of the label source."""
        inputs = (self.distance_m, self.mount_distance_m, self.arm_reach_m, self.visibility)
        return heuristic(*inputs, params)[1] == 1

    def gains(self) -> F64:
        """Gains (N,) in balanced accuracy by label 1 for each candidate, in whole units: sums are exact."""
        positives = int(self.label.sum())
        return np.where(self.label, len(self) - positives, -positives).astype(np.float64)


def begin_from(before: HeuristicParams, form: Distance) -> HeuristicParams:
    """Initial parameters of a fit with this distance; those that are not fitted stay.

    For shares of the reach the bounds are 0 and 1: targets beyond the reach cannot be grasped, and sigma_l
    covers those that are too near.
    """
    if form == before.distance:
        return before
    bounds = (0.14, 0.92) if form == "planar" else (0.0, 1.0)
    return before.model_copy(update={"distance": form, "d_min": bounds[0], "d_max": bounds[1]})


def fit(trials: Trials, before: HeuristicParams, forms: Sequence[Distance]) -> HeuristicParams:
    """The parameters mu, sigma_l, sigma_r and tau with the best balanced accuracy; others stay.

    The first of equally good forms wins. tau stays above alpha vis(1), so that a distance outside
    [d_min, d_max] is never good. Deterministic, and independent of the order of rows.
    """
    gains = trials.gains()
    found = [_fit_form(trials, gains, begin_from(before, form)) for form in forms]
    return max(found, key=lambda params: float(gains @ trials.labels_by(params)))


def _fit_form(trials: Trials, gains: F64, start: HeuristicParams) -> HeuristicParams:
    """Differential evolution (Storn and Price 1997), with a fixed seed, over rounded parameters."""
    d = effective_distance(trials.distance_m, trials.mount_distance_m, trials.arm_reach_m, start)
    inside = (d >= start.d_min) & (d <= start.d_max)
    if not inside.any():
        return start
    d, gains = d[inside, None], gains[inside]
    seen = start.alpha * visibility_score(trials.visibility[inside, None].astype(np.float64))
    height, least = (1 - start.alpha) * start.a, start.alpha * float(visibility_score(np.ones(1))[0])

    def loss(points: F64) -> F64:
        """Minus the gains (K,) of parameters (4, K)."""
        mu, sigma_l, sigma_r, tau = np.round(points, _DECIMALS)
        off = (d - mu) / np.where(d < mu, sigma_l, sigma_r)
        return -(gains @ (seen + height * np.exp(-0.5 * off**2) >= tau))

    unit = 10.0**-_DECIMALS
    nearest, farthest = max(float(d.min()), unit), max(float(d.max()), 2 * unit)
    bounds = [(nearest, farthest), _SIGMAS, _SIGMAS, (least + 10 * unit, least + 0.995 * height)]
    # Steps begin at random points: from the best one some searches ended in a local optimum. Without a
    # tolerance: on a plateau of equal gains the population has no spread.
    best = differential_evolution(
        loss,
        bounds,
        strategy="rand1bin",
        rng=0,
        polish=False,
        vectorized=True,
        updating="deferred",
        popsize=_POPULATION,
        maxiter=_GENERATIONS,
        tol=0,
        atol=-1,
    )
    rounded = {name: round(float(value), _DECIMALS) for name, value in zip(_FITTED, best.x, strict=True)}
    return HeuristicParams.model_validate({**start.model_dump(), **rounded})


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Labels (N,) by rules fitted on other houses, and the rule of each fold."""

    labels: Bools
    params: tuple[HeuristicParams, ...]


def fit_leaving_houses_out(
    trials: Trials, refit: Callable[[Trials], HeuristicParams], step: Callable[[], None] = lambda: None
) -> LeftOut:
    """Label the candidates of each of `FOLDS` folds of houses by a rule fitted on the other folds."""
    houses, house = np.unique(trials.house.astype(str), return_inverse=True)
    folds = min(FOLDS, len(houses))
    dealt = np.random.default_rng([0, 0]).permutation(len(houses)) % folds
    fold = dealt[house][trials.scene]
    labels = np.zeros(len(trials), np.bool_)
    params: list[HeuristicParams] = []
    for k in range(folds):
        inside = fold != k
        if trials.label[inside].all() or not trials.label[inside].any():
            problem = f"those of label {int(not trials.label[inside].any())} are in too few houses"
            raise InputError("labels", "house_id", problem, "Name runs of more houses")
        params.append(refit(trials.at(inside)))
        labels[~inside] = trials.at(~inside).labels_by(params[-1])
        step()
    return LeftOut(labels, tuple(params))


def refuse_too_little(trials: Trials, place: str) -> None:
    """Raise InputError for labels of one class, few scenes or one house."""
    fix = "Name more runs, or make more labels"
    if not len(trials):
        raise InputError(place, "--candidates", "selects no candidate", "Choose another set")
    if trials.label.all() or not trials.label.any():
        problem = f"all {len(trials):,} labels are {int(trials.label[0])}"
        raise InputError(place, "label", problem, "Choose other --candidates, or name more runs")
    if len(trials.house) < MIN_SCENES:
        problem = f"{len(trials.house)} scenes, but intervals need {MIN_SCENES}; 100 or more are sensible"
        raise InputError(place, "scenes", problem, fix)
    if len(set(trials.house)) < 2:
        problem = "all scenes are in one house, so none is left for validation"
        raise InputError(place, "house_id", problem, fix)


def agreements(trials: Trials, labels: Sequence[Bools]) -> list[tuple[Estimate, Estimate]]:
    """Accuracy and balanced accuracy of each rule's labels (N,), all over the same resampled scenes."""
    n_scenes = len(trials.house)
    weights = resample_weights(n_scenes, RESAMPLES, np.random.default_rng([0, 1]))
    found: list[tuple[Estimate, Estimate]] = []
    for by_rule in labels:
        by_scene = confusion(by_rule.astype(np.float64), trials.label, trials.scene, n_scenes)
        counts, resampled = by_scene.sum(axis=0), summed(weights, by_scene)
        right, balanced = (Estimate(float(m(counts)), m(resampled)) for m in (accuracy, balanced_accuracy))
        found.append((right, balanced))
    return found
