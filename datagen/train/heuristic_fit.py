"""Fit the distance-visibility rule to labels of grasp trials: the parameters that the paper does not give.

With H = alpha vis(rho) + (1 - alpha) dist(d), a candidate is good where its distance is at most k(rho) sigmas
from mu (`reach_in_sigmas`). Given mu, tau and alpha, a candidate nearer than mu thus depends on sigma_l alone
and a farther one on sigma_r alone, and each sigma is the best cut of one sorted list: exact, and linear in
the labels. The search is over mu and tau, and over alpha if requested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import product
from typing import Literal, get_args

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.specification import HeuristicParams
from datagen.train.evaluation.bootstrap import Estimate, resample_weights, summed
from datagen.train.evaluation.metrics import accuracy, balanced_accuracy, confusion
from datagen.train.inputs import F32, F64, I64, Array, Bools
from datagen.workers.labels.distance_visibility_score import effective_distance, heuristic, visibility_score

Form = Literal["planar", "planar-over-reach", "mount-over-reach"]
Objective = Literal["balanced", "accuracy"]

FORMS: tuple[Form, ...] = get_args(Form)
FOLDS = 5
# Fewer scenes give no meaningful interval.
MIN_SCENES = 10
# Decimals of parameters: a tenth of a millimetre.
DECIMALS = 4

# The initial grid of the search, the number of best points to refine, and of rounds.
_MUS = 49
_ALPHAS = np.linspace(0.0, 0.9, 10)
# k at rho = 1, in place of tau: from 0.1, where no less visible target is good, to 3.5, where dist hardly
# counts.
_SIGMAS_IN_SIGHT = np.linspace(0.1, 3.5, 49)
_BEAM, _ROUNDS = 16, 7
# Below the first a sigma is a step at mu; the second is the largest that the specification allows.
_SIGMA_LOW, _SIGMA_HIGH = 0.01, 10.0


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

    @property
    def n_scenes(self) -> int:
        """S."""
        return len(self.house)

    def at(self, rows: Bools) -> Trials:
        """Some of the candidates (N,), with the scenes that they belong to."""
        scenes, scene = np.unique(self.scene[rows], return_inverse=True)
        cut = {f.name: getattr(self, f.name)[rows] for f in fields(self)[2:]}
        return Trials(scene, self.house[scenes], **cut)

    def labels_by(self, params: HeuristicParams) -> Bools:
        """The rule's labels (N,), by the code of the label source."""
        inputs = (self.distance_m, self.mount_distance_m, self.arm_reach_m, self.visibility)
        return heuristic(*inputs, params)[1] == 1


def begin_from(before: HeuristicParams, form: Form) -> HeuristicParams:
    """Initial parameters of a fit with this distance; those that are not fitted stay.

    For shares of the reach the bounds are 0 and 1: targets beyond the reach cannot be grasped, and sigma_l
    covers those that are too near.
    """
    if form == before.distance:
        return before
    bounds = (0.14, 0.92) if form == "planar" else (0.0, 1.0)
    return before.model_copy(update={"distance": form, "d_min": bounds[0], "d_max": bounds[1]})


def fit(
    trials: Trials,
    before: HeuristicParams,
    forms: Sequence[Form],
    objective: Objective = "balanced",
    fit_alpha: bool = False,
) -> HeuristicParams:
    """The parameters mu, sigma_l, sigma_r, tau (and alpha) that agree best with the labels; others stay.

    The first of equally good forms wins. tau stays above alpha vis(1), so that a
    distance outside [d_min, d_max] is never good. Deterministic, and independent of the order of rows.
    """
    gains = _gains(trials.label, objective)
    found = [_fit_form(trials, gains, begin_from(before, form), fit_alpha) for form in forms]
    return max(found, key=lambda params: int(gains[trials.labels_by(params)].sum()))


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Labels (N,) by rules fitted on other houses, and the rule of each fold."""

    labels: Bools
    params: tuple[HeuristicParams, ...]


def fit_leaving_houses_out(
    trials: Trials,
    refit: Callable[[Trials], HeuristicParams],
    seed: int,
    step: Callable[[], None] = lambda: None,
) -> LeftOut:
    """Label the candidates of each of `FOLDS` folds of houses by a rule fitted on the other folds."""
    houses, house = np.unique(trials.house.astype(str), return_inverse=True)
    folds = min(FOLDS, len(houses))
    dealt = np.random.default_rng([seed, 0]).permutation(len(houses)) % folds
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
    fix = "Name more runs, or make more labels with `datagen resume RUN --n N`"
    if not len(trials):
        raise InputError(place, "--candidates", "selects no candidate", "Choose another set")
    if trials.label.all() or not trials.label.any():
        problem = f"all {len(trials):,} labels are {int(trials.label[0])}"
        raise InputError(place, "label", problem, "Choose other --candidates, or name more runs")
    if trials.n_scenes < MIN_SCENES:
        problem = f"{trials.n_scenes} scenes, but intervals need {MIN_SCENES}; 100 or more are sensible"
        raise InputError(place, "scenes", problem, fix)
    if len(set(trials.house)) < 2:
        problem = "all scenes are in one house, so none is left for validation"
        raise InputError(place, "house_id", problem, fix)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Agreement of a rule's labels with those of trials: true/false positives, false/true negatives."""

    confusion: F64  # (4,)
    accuracy: Estimate
    balanced_accuracy: Estimate


def agreements(trials: Trials, labels: Sequence[Bools], resamples: int, seed: int) -> list[Agreement]:
    """Agreement of each rule's labels (N,) with the trials, all over the same resampled scenes."""
    weights = resample_weights(trials.n_scenes, resamples, np.random.default_rng([seed, 1]))
    found: list[Agreement] = []
    for of_rule in labels:
        by_scene = confusion(of_rule.astype(np.float64), trials.label, trials.scene, trials.n_scenes)
        counts, resampled = by_scene.sum(axis=0), summed(weights, by_scene)
        metrics = (accuracy, balanced_accuracy)
        estimates = (Estimate(float(metric(counts)), metric(resampled)) for metric in metrics)
        found.append(Agreement(counts, *estimates))
    return found


def reach_in_sigmas(visible: F64, params: HeuristicParams) -> F64:
    """Distance |d - mu| (N,) in sigmas at which H is tau, from visibility scores; nan where H < tau at mu.

    From a exp(-k^2 / 2) = (tau - alpha vis) / (1 - alpha). Requires tau > alpha vis.
    """
    needed = (params.tau - params.alpha * visible) / ((1 - params.alpha) * params.a)
    with np.errstate(invalid="ignore"):
        return np.sqrt(-2 * np.log(needed))


def _gains(label: Bools, objective: Objective) -> I64:
    """Gains (N,) of the objective by label 1 for each candidate, in whole units, so that sums are exact."""
    positives = int(label.sum())
    for_good, for_bad = (len(label) - positives, -positives) if objective == "balanced" else (1, -1)
    return np.where(label, for_good, for_bad).astype(np.int64)


def _fit_form(trials: Trials, gains: I64, start: HeuristicParams, fit_alpha: bool) -> HeuristicParams:
    d = effective_distance(trials.distance_m, trials.mount_distance_m, trials.arm_reach_m, start)
    inside = (d >= start.d_min) & (d <= start.d_max)
    d, gains = d[inside], gains[inside]
    visible = visibility_score(trials.visibility[inside].astype(np.float64))
    if not len(d):
        return start

    def at(point: Sequence[float]) -> tuple[int, HeuristicParams]:
        mu, sigmas_in_sight, alpha = point
        above = (1 - alpha) * start.a * np.exp(-0.5 * sigmas_in_sight**2)
        tau = alpha * float(visibility_score(np.ones(1))[0]) + above
        params = start.model_copy(update={"mu": mu, "tau": tau, "alpha": alpha})
        return _with_best_sigmas(d, visible, gains, params)

    mus = np.linspace(max(float(d.min()), 10.0**-DECIMALS), max(float(d.max()), 10.0**-DECIMALS), _MUS)
    axes = (mus, _SIGMAS_IN_SIGHT, np.array([start.alpha]))
    if fit_alpha:
        axes = (mus[::2], _SIGMAS_IN_SIGHT[::2], _ALPHAS)
    best = _beam_search(at, axes)
    fitted = ("mu", "sigma_l", "sigma_r", "tau", *(("alpha",) if fit_alpha else ()))
    rounded = {name: round(getattr(best, name), DECIMALS) for name in fitted}
    return HeuristicParams.model_validate({**best.model_dump(), **rounded})


def _with_best_sigmas(
    d: F64, visible: F64, gains: I64, params: HeuristicParams
) -> tuple[int, HeuristicParams]:
    """The gain with the best sigmas for these mu, tau and alpha, and the parameters with them."""
    k = reach_in_sigmas(visible, params)
    possible = k > 0  # false for nan as well
    off = (d[possible] - params.mu) / k[possible]
    gain, far = gains[possible], off >= 0
    gain_l, sigma_l = _best_cut(-off[~far], gain[~far], params.sigma_l)
    gain_r, sigma_r = _best_cut(off[far], gain[far], params.sigma_r)
    return gain_l + gain_r, params.model_copy(update={"sigma_l": sigma_l, "sigma_r": sigma_r})


def _best_cut(needed: F64, gains: I64, otherwise: float) -> tuple[int, float]:
    """The best gain with label 1 where `needed` (M,) is at most sigma, and sigma; `otherwise` for no rows."""
    if not len(needed):
        return 0, otherwise
    order = np.argsort(needed)
    needed, total = needed[order], np.cumsum(gains[order])
    # A cut lies between the last row with label 1 and the next; at the first cut no row has label 1.
    below, above = np.concatenate([[0.0], needed]), np.concatenate([needed, needed[-1:] * 1.05])
    total = np.concatenate([[0], total])
    cuts = np.flatnonzero((below < above) & (below < _SIGMA_HIGH) & (above > _SIGMA_LOW))
    if not len(cuts):
        return int(total[-1]), _SIGMA_LOW  # all are closer to mu than any sigma
    at = cuts[np.argmax(total[cuts])]
    return int(total[at]), float(np.clip((below[at] + above[at]) / 2, _SIGMA_LOW, _SIGMA_HIGH))


def _beam_search(
    at: Callable[[Sequence[float]], tuple[int, HeuristicParams]], axes: Sequence[F64]
) -> HeuristicParams:
    """The best of a grid, then of finer neighbourhoods of its best points."""
    lows, highs = [axis[0] for axis in axes], [axis[-1] for axis in axes]
    steps = [(axis[-1] - axis[0]) / max(len(axis) - 1, 1) for axis in axes]
    points = [tuple(map(float, point)) for point in product(*axes)]
    known: dict[tuple[float, ...], tuple[int, HeuristicParams]] = {}
    for _ in range(_ROUNDS + 1):
        known |= {point: at(point) for point in points if point not in known}
        best = sorted(known, key=lambda point: -known[point][0])[:_BEAM]
        known = {point: known[point] for point in best}
        steps = [step / 2.5 for step in steps]
        moves = [(-1, 0, 1) if step else (0,) for step in steps]
        points = list(
            dict.fromkeys(
                tuple(
                    float(np.clip(x + move * step, low, high))
                    for x, move, step, low, high in zip(point, moved, steps, lows, highs, strict=True)
                )
                for point in best
                for moved in product(*moves)
            )
        )
    return known[next(iter(known))][1]
