"""Metrics against plain counting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.train import metrics

# Few distinct scores, so that ties are common; infinities as of methods that rule candidates out.
SCORES = st.sampled_from([-np.inf, 0.0, 0.25, 0.5, 0.500001, 1.0, 3.0])
TOLD = st.lists(st.tuples(st.booleans(), SCORES), min_size=2, max_size=40)


def arrays(told: list[tuple[bool, float]]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([t for t, _ in told]), np.array([s for _, s in told], np.float64)


@given(TOLD)
def test_the_area_under_roc_is_the_share_of_pairs_in_the_right_order(told: list[tuple[bool, float]]) -> None:
    true, score = arrays(told)
    pairs = [(a > b) + (a == b) / 2 for a in score[true] for b in score[~true]]
    area = metrics.area_under_roc(true, score)
    if pairs:
        assert area == pytest.approx(np.mean(pairs))
        assert metrics.area_under_roc(~true, score) == pytest.approx(1 - np.mean(pairs))
    else:
        assert np.isnan(area)


@given(TOLD)
def test_curves_equal_the_rates_at_every_threshold(told: list[tuple[bool, float]]) -> None:
    true, score = arrays(told)
    if true.all() or not true.any():
        return
    said = [score >= t for t in sorted(set(score.tolist()), reverse=True)]
    roc = metrics.roc(true, score)
    np.testing.assert_allclose(roc.x, [0, *((~true & s).sum() / (~true).sum() for s in said)])
    np.testing.assert_allclose(roc.y, [0, *((true & s).sum() / true.sum() for s in said)])
    precision = [(true & s).sum() / s.sum() for s in said]
    by_hand = (np.diff(roc.y) * precision).sum()
    assert metrics.average_precision(true, score) == pytest.approx(by_hand)


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 3)), min_size=1, max_size=40))
def test_confusions_are_counted_by_group(told: list[tuple[bool, bool, int]]) -> None:
    true, said, group = (np.array(column) for column in zip(*told, strict=True))
    counts = metrics.confusion(said.astype(np.float64), true, group, 4)
    for k in range(4):
        mine = [(t, s) for t, s, g in told if g == k]
        expected = [mine.count(pair) for pair in ((True, True), (False, True), (True, False), (False, False))]
        assert counts[k].tolist() == expected
        if mine:
            assert metrics.accuracy(counts)[k] == pytest.approx(np.mean([t == s for t, s in mine]))
        else:
            assert np.isnan(metrics.accuracy(counts)[k])


def test_perfect_and_constant_scorers() -> None:
    rng = np.random.default_rng(0)
    true = rng.random(500) < 0.05
    group = np.zeros(500, np.int64)
    perfect = metrics.confusion(true.astype(np.float64), true, group, 1)
    nothing = metrics.confusion(np.zeros(500), true, group, 1)
    assert metrics.accuracy(perfect) == metrics.balanced_accuracy(perfect) == 1
    assert metrics.accuracy(nothing) > 0.9 and metrics.balanced_accuracy(nothing) == 0.5


def test_calibration_measures_overconfidence() -> None:
    rng = np.random.default_rng(1)
    p = rng.random(200_000)
    true = rng.random(len(p)) < p
    honest = metrics.reliability(true, p)
    assert len(honest.count) == metrics.N_BINS and honest.count.sum() == len(p)
    np.testing.assert_allclose(honest.predicted, honest.true, atol=0.015)
    assert honest.expected_error < 0.01
    # The mean of p(1 - p) over p uniform in [0, 1].
    assert metrics.brier(true, p) == pytest.approx(1 / 6, abs=0.003)
    boastful = metrics.reliability(true, (p > 0.5).astype(np.float64))
    assert boastful.expected_error == pytest.approx(0.25, abs=0.01)
    assert boastful.count.tolist() == [int((p <= 0.5).sum()), int((p > 0.5).sum())]


def test_a_thinned_curve_keeps_its_ends_and_its_shape() -> None:
    rng = np.random.default_rng(2)
    true = rng.random(20_000) < 0.01
    score = rng.normal(size=20_000) + 2 * true
    curve = metrics.roc(true, score)
    thin = curve.thinned(200)
    assert len(thin.x) <= 200 < len(curve.x)
    assert (thin.x[0], thin.y[0], thin.x[-1], thin.y[-1]) == (0, 0, 1, 1)
    assert np.trapezoid(thin.y, thin.x) == pytest.approx(metrics.area_under_roc(true, score), abs=0.005)
