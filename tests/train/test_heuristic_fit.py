"""Fitting the distance-visibility rule: labels made by a hidden rule are found again, in any order."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.schemas.specification import DISTANCES, HeuristicParams
from datagen.train.heuristic_fit import (
    Trials,
    agreements,
    begin_from,
    fit,
    fit_leaving_houses_out,
    refuse_too_little,
)

BEFORE = HeuristicParams()
N, SCENES = 600, 30


def make_trials(seed: int, n: int = N, scenes: int = SCENES, houses: int = 12) -> Trials:
    """Random candidates, seen like stored ones: hidden, half hidden or in full sight. Labels are noise."""
    rng = np.random.default_rng(seed)
    planar_m = rng.uniform(0.1, 1.2, n)
    seen = rng.choice([0.0, 0.5, 1.0], n, p=[0.15, 0.25, 0.6])
    return Trials(
        scene=np.arange(n) % scenes,
        house=np.array([f"house-{k % houses}" for k in range(scenes)], object),
        distance_m=planar_m.astype(np.float32),
        mount_distance_m=np.hypot(planar_m, rng.uniform(0, 0.4, n)).astype(np.float32),
        arm_reach_m=rng.uniform(0.5, 1.0, n).astype(np.float32),
        visibility=np.where(seen == 0.5, rng.uniform(0, 1, n), seen).astype(np.float32),
        label=rng.random(n) < 0.4,
    )


hidden_rules = st.builds(
    lambda form, mu, sigma_l, sigma_r, sigmas: begin_from(BEFORE, form).model_copy(
        update={
            "mu": mu,
            "sigma_l": sigma_l,
            "sigma_r": sigma_r,
            "tau": 0.51 * 0.6 + 0.49 * float(np.exp(-0.5 * sigmas**2)),
        }
    ),
    st.sampled_from(DISTANCES),
    st.floats(0.35, 0.8),
    st.floats(0.05, 0.4),
    st.floats(0.05, 0.4),
    st.floats(0.8, 2.2),
)


# A search that steps from the best point so far ends beside these two.
WIDE = BEFORE.model_copy(update={"mu": 0.6875, "sigma_l": 0.375, "sigma_r": 0.1875, "tau": 0.504657})


@given(hidden_rules, st.integers(0, 1000))
@example(WIDE, 1)
@example(WIDE, 5)
@settings(max_examples=4, deadline=None)
def test_labels_of_a_hidden_rule_are_found_again(hidden: HeuristicParams, seed: int) -> None:
    trials = make_trials(seed)
    trials = replace(trials, label=trials.labels_by(hidden))
    if trials.label.sum() < 20:
        return  # nothing but luck says where so few come from
    found = fit(trials, BEFORE, [hidden.distance])
    assert (trials.labels_by(found) == trials.label).mean() > 0.99
    assert (found.distance, found.alpha, found.a) == (hidden.distance, hidden.alpha, hidden.a)
    assert (found.d_min, found.d_max) == (hidden.d_min, hidden.d_max)


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_row_order_changes_neither_the_fit_nor_the_report(seed: int) -> None:
    trials = make_trials(seed, n=240)
    order = np.random.default_rng(seed).permutation(len(trials))
    columns = ("scene", "distance_m", "mount_distance_m", "arm_reach_m", "visibility", "label")
    other = replace(trials, **{name: getattr(trials, name)[order] for name in columns})
    assert fit(trials, BEFORE, ["planar"]) == fit(other, BEFORE, ["planar"])

    def refit(some: Trials) -> HeuristicParams:
        return BEFORE.model_copy(update={"mu": float(np.median(some.distance_m[some.label]))})

    ours, theirs = (fit_leaving_houses_out(t, refit) for t in (trials, other))
    assert ours.params == theirs.params
    np.testing.assert_array_equal(ours.labels[order], theirs.labels)
    a, b = (agreements(t, [left.labels])[0][1] for t, left in ((trials, ours), (other, theirs)))
    assert a.value == b.value
    np.testing.assert_array_equal(a.resamples, b.resamples)


@pytest.mark.parametrize("form", DISTANCES)
def test_no_random_rule_does_better_than_the_fitted_one(form: Any) -> None:
    """On labels that no rule explains, the fit is at least as good as the best of 2,000 guesses."""
    trials, rng = make_trials(7, n=400), np.random.default_rng(8)
    # Good ones lie nearer, so that there is something to find.
    near = trials.distance_m < rng.normal(0.6, 0.3, len(trials))
    trials = replace(trials, label=near)

    def balanced(params: HeuristicParams) -> float:
        return float(trials.gains() @ trials.labels_by(params))

    start = begin_from(BEFORE, form)
    guesses = (
        start.model_copy(update=dict(zip(("mu", "sigma_l", "sigma_r", "tau"), drawn, strict=True)))
        for drawn in rng.uniform([0.2, 0.02, 0.02, 0.31], [1.0, 1.0, 1.0, 0.75], (2000, 4)).tolist()
    )
    assert balanced(fit(trials, BEFORE, [form])) >= max(map(balanced, guesses))


def test_every_house_is_labelled_by_a_rule_fitted_on_other_houses() -> None:
    trials, seen = make_trials(1), list[set[str]]()

    def refit(some: Trials) -> HeuristicParams:
        seen.append(set(some.house[np.unique(some.scene)]))
        assert len(some.house) == len(np.unique(some.scene))
        # A rule that is known by its mu: it says which fold it was fitted for.
        return BEFORE.model_copy(update={"mu": 0.1 * len(seen)})

    steps = list[int]()
    left_out = fit_leaving_houses_out(trials, refit, lambda: steps.append(1))
    assert len(steps) == len(left_out.params) == 5
    for k, (houses, params) in enumerate(zip(seen, left_out.params, strict=True)):
        unseen = np.array([trials.house[s] not in houses for s in trials.scene])
        assert unseen.any(), k
        np.testing.assert_array_equal(left_out.labels[unseen], trials.labels_by(params)[unseen])
    assert sorted(h for houses in seen for h in set(trials.house) - houses) == sorted(set(trials.house))


def test_overfitting_to_noise_shows_only_on_the_fitted_houses() -> None:
    trials = make_trials(6, n=300)

    def refit(some: Trials) -> HeuristicParams:
        return fit(some, BEFORE, ["planar"])

    left_out = fit_leaving_houses_out(trials, refit).labels
    right, (_, fitted), (_, unseen) = agreements(
        trials, [trials.label, trials.labels_by(refit(trials)), left_out]
    )
    assert [(estimate.value, estimate.interval()) for estimate in right] == [(1, (1, 1))] * 2
    assert fitted.interval()[0] > 0.5
    low, high = unseen.interval()
    assert low < 0.5 < high


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: replace(t, label=np.zeros(len(t), bool)), "label: all 600 labels are 0"),
        (lambda t: t.at(t.scene < 9), "9 scenes"),
        (lambda t: replace(t, house=np.full(SCENES, "one", object)), "one house"),
        (lambda t: t.at(np.zeros(len(t), bool)), "no candidate"),
    ],
)
def test_too_few_labels_are_refused(change: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        refuse_too_little(change(make_trials(0)), "runs")
    trials = make_trials(0)
    refuse_too_little(trials, "runs")
    label = np.array([trials.house[s] == "house-3" for s in trials.scene])
    with pytest.raises(InputError, match="too few houses"):
        fit_leaving_houses_out(replace(trials, label=label), lambda _: BEFORE)
