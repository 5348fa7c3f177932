"""The bootstrap by scene: the same as resampling rows by hand, and its intervals cover what they should."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.train import metrics
from datagen.train.bootstrap import Estimate, resample_weights, resampled_area_under_roc, summed, verdict


@given(st.integers(0, 2**32), st.integers(1, 70), st.integers(1, 6))
@settings(deadline=None, max_examples=25)
def test_weighted_sums_equal_sums_of_resampled_rows(seed: int, n_scenes: int, levels: int) -> None:
    rng = np.random.default_rng(seed)
    n = 4 * n_scenes
    scene = rng.integers(0, n_scenes, n)
    true, score = rng.random(n) < 0.4, rng.integers(0, levels, n).astype(np.float64)
    said = (score > levels / 2).astype(np.float64)
    weights = resample_weights(n_scenes, 10, rng)
    assert (weights.sum(axis=1) == n_scenes).all()
    areas = resampled_area_under_roc(weights, true, score, scene)
    counts = summed(weights, metrics.confusion(said, true, scene, n_scenes))
    for k, drawn in enumerate(weights):
        rows = np.repeat(np.arange(n), drawn[scene])  # those of a scene as often as it was drawn
        expected = metrics.area_under_roc(true[rows], score[rows])
        assert areas[k] == pytest.approx(expected, nan_ok=True)
        one = metrics.confusion(said[rows], true[rows], np.zeros(len(rows), np.int64), 1)
        np.testing.assert_allclose(counts[k], one[0])


def test_intervals_have_their_nominal_coverage() -> None:
    # Scenes differ in difficulty: 200 rows of one scene are far from 200 independent ones.
    rng = np.random.default_rng(0)
    covered = naive = 0
    for _ in range(200):
        skill = rng.beta(6, 2, 60)  # mean 0.75
        right = rng.binomial(200, skill)
        per_scene = np.stack([right, np.zeros(60), 200 - right, np.zeros(60)], axis=1).astype(np.float64)
        weights = resample_weights(60, 300, rng)
        whole, drawn = per_scene.sum(axis=0), summed(weights, per_scene)
        value = float(metrics.accuracy(whole))
        low, high = Estimate(value, metrics.accuracy(drawn)).interval()
        covered += low <= 0.75 <= high
        naive += abs(value - 0.75) <= 1.96 * np.sqrt(value * (1 - value) / 12_000)
    assert 0.90 <= covered / 200 <= 0.99
    assert naive / 200 < 0.6


def test_paired_differences_are_more_precise_than_disjoint_intervals() -> None:
    rng = np.random.default_rng(3)
    hard = rng.beta(2, 2, 80)[:, None]
    weights = resample_weights(80, 1000, rng)
    right = {name: rng.binomial(100, np.clip(hard + up, 0, 1))[:, 0] for name, up in (("a", 0.06), ("b", 0))}
    estimates = {
        name: Estimate(count.sum() / 8000, summed(weights, count.astype(np.float64)) / 8000)
        for name, count in right.items()
    }
    a, b = estimates["a"], estimates["b"]
    assert verdict(a.minus(b)) == "above" and verdict(b.minus(a)) == "below"
    assert verdict(a.minus(a)) == "open"
    assert a.interval()[0] < b.interval()[1]


def test_shares_of_0_and_1_have_exact_intervals() -> None:
    all_alike = np.ones(50)
    low, high = Estimate(1.0, all_alike, trials=19).interval()
    assert (low, high) == (pytest.approx(0.8235, abs=1e-4), 1)
    assert Estimate(0.0, 1 - all_alike, trials=19).interval() == (0, pytest.approx(1 - low))
    both = Estimate(1.0, all_alike, 19)
    assert both.minus(both).interval() == (0, 0) and verdict(both.minus(both)) == "open"


def test_undefined_resamples_have_no_interval() -> None:
    weights = resample_weights(5, 50, np.random.default_rng(0))
    scene, true = np.arange(5), np.array([True, False, False, False, False])
    areas = resampled_area_under_roc(weights, true, np.arange(5.0), scene)
    assert 0 < np.isnan(areas).sum() < 50
    assert Estimate(0.0, areas).interval() == (0.0, 0.0)
    nothing = resampled_area_under_roc(weights, np.zeros(5, np.bool_), np.arange(5.0), scene)
    assert np.isnan(Estimate(float("nan"), nothing).interval()).all()
    assert verdict(Estimate(float("nan"), nothing)) == "open"
