"""Predictions of dear labels that are fitted on other scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.estimation.cross_fitting import SCENES_AT_LEAST, cross_fitted
from datagen.estimation.rates import Population, estimate_rate
from datagen.train.inputs import F64, Bools

SCENES, PER_SCENE, DEAR = 300, 10, 80


def drawn(rng: np.random.Generator) -> tuple[Population, F64, Bools]:
    """Labels that depend on the square of a feature, so that no linear column helps; and which are clear."""
    n = SCENES * PER_SCENE
    features = rng.normal(size=(n, 3))
    label = rng.random(n) < 0.9 * (features[:, 0] ** 2 > 0.7)
    scene = np.repeat(np.arange(SCENES), PER_SCENE)
    dear = np.isin(scene, rng.choice(SCENES, DEAR, replace=False))
    is_clear = rng.random(n) < 0.8
    return (
        Population(SCENES, scene, features[:, :1], dear, label & is_clear, np.full(n, DEAR / SCENES)),
        features,
        is_clear,
    )


def test_a_scenes_predictions_do_not_depend_on_its_labels() -> None:
    population, features, is_clear = drawn(np.random.default_rng(0))
    scene = int(population.scene[population.is_dear][0])
    rows = population.scene == scene
    before = cross_fitted(population, features, is_clear)
    after = cross_fitted(replace(population, label=population.label ^ rows), features, is_clear)
    assert before is not None and after is not None
    np.testing.assert_array_equal(before[rows], after[rows])
    assert (before[~rows] != after[~rows]).any()
    assert not before[~is_clear].any() and before.min() >= 0 and before.max() <= 1


def test_too_few_scenes_give_no_prediction() -> None:
    population, features, is_clear = drawn(np.random.default_rng(0))
    few = population.is_dear & (np.cumsum(population.is_dear) <= PER_SCENE * (SCENES_AT_LEAST - 1))
    assert cross_fitted(replace(population, is_dear=few), features, is_clear) is None


def test_intervals_with_predictions_are_narrow_and_hold_the_truth() -> None:
    rng = np.random.default_rng(1)
    # Of a normal feature, times the clear ones.
    truth = 0.9 * 0.8 * 2 * 0.201392
    held, ratios = [], []
    for _ in range(400):
        population, features, is_clear = drawn(rng)
        prediction = cross_fitted(population, features, is_clear)
        assert prediction is not None
        everywhere = np.ones(len(is_clear))
        found = estimate_rate(replace(population, cheap=prediction[:, None]), everywhere)
        assert found is not None
        held.append(found.mixed.low <= truth <= found.mixed.high)
        ratios.append(found.mixed.half_width / found.dear_alone.half_width)
    assert 0.92 <= np.mean(held) <= 0.98
    assert np.mean(ratios) < 0.8
