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
def test_the_average_precision_is_that_at_every_threshold(told: list[tuple[bool, float]]) -> None:
    true, score = arrays(told)
    if not true.any():
        return
    said = [score >= t for t in sorted(set(score.tolist()), reverse=True)]
    recall = [0, *((true & s).sum() / true.sum() for s in said)]
    precision = [(true & s).sum() / s.sum() for s in said]
    assert metrics.average_precision(true, score) == pytest.approx((np.diff(recall) * precision).sum())


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
    assert metrics.expected_calibration_error(true, p) < 0.01
    # The mean of p(1 - p) over p uniform in [0, 1].
    assert metrics.brier(true, p) == pytest.approx(1 / 6, abs=0.003)
    boastful = (p > 0.5).astype(np.float64)
    assert metrics.expected_calibration_error(true, boastful) == pytest.approx(0.25, abs=0.01)
