"""Robust scores against numbers worked out by hand, and against a distribution whose scores are known."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.html_report.outliers import (
    THRESHOLD,
    Measure,
    arcsine,
    log,
    most_unusual,
    outliers_of,
    robust_z,
)

NAN = float("nan")


def measure(name: str, *values: float) -> Measure:
    return Measure(name, np.array(values, np.float64), np.asarray)


def test_scores_by_hand() -> None:
    # Median 5, absolute deviations 4 3 2 1 0 1 2 3 95: their median is 2.
    values = np.array([1, 2, 3, 4, 5, 6, 7, 8, 100], np.float64)
    assert robust_z(values) == pytest.approx((values - 5) / (1.4826 * 2))


def test_scores_where_most_values_are_equal() -> None:
    # The MAD is 0; the mean absolute deviation is 10 / 10.
    values = np.array([3.0] * 9 + [13.0])
    assert robust_z(values) == pytest.approx((values - 3) / 1.2533)


@pytest.mark.parametrize(
    "values", [[], [1.0, 2, 3, 4, 5, 6, 1000], [2.0] * 20, [NAN] * 20, [NAN] * 15 + [1, 9]]
)
def test_few_or_equal_values_have_no_scores(values: list[float]) -> None:
    assert (robust_z(np.array(values, np.float64)) == 0).all()


def test_scores_of_a_normal_distribution_have_unit_variance() -> None:
    values = np.random.default_rng(0).normal(7, 3, 100_000)
    assert robust_z(values).std() == pytest.approx(1, abs=0.01)


def test_unknown_values_leave_the_others_alone() -> None:
    values = np.random.default_rng(1).normal(size=50)
    with_gaps = np.insert(values, [3, 20], NAN)
    known = np.isfinite(with_gaps)
    assert (robust_z(with_gaps)[known] == robust_z(values)).all() and (robust_z(with_gaps)[~known] == 0).all()


def test_the_largest_outlier_is_first() -> None:
    usual = np.random.default_rng(2).normal(size=40).clip(-2, 2)
    found = outliers_of([measure("a", *usual, 20.0, 0.0), measure("b", *usual, 0.0, -60.0)])
    assert [(o.row, o.measure) for o in found] == [(41, "b"), (40, "a")]
    assert found[0].value == -60 and found[0].score < -THRESHOLD < THRESHOLD < found[1].score


def test_no_measure_fills_the_list_of_scenes() -> None:
    rng = np.random.default_rng(3)
    wild, tame = rng.normal(size=60) ** 9, rng.normal(size=60)
    chosen = most_unusual([measure("wild", *wild), measure("tame", *tame)], 6, 3)
    assert [o.measure for _, o in chosen] == ["wild"] * 3 + ["tame"] * 3
    assert len({row for row, _ in chosen}) == 6
    scores = np.abs(robust_z(wild))
    assert [row for row, _ in chosen[:3]] == np.argsort(-scores)[:3].tolist()


def test_scales_and_texts() -> None:
    assert arcsine(np.array([0, 0.5, 1])) == pytest.approx([0, np.pi / 4, np.pi / 2])
    scaled = log(np.array([0, 1, np.e]))
    assert np.isnan(scaled[0]) and scaled[1:] == pytest.approx([0, 1])
    share = Measure("rate", np.array([0.1234]), arcsine, "%")
    assert share.text(0.1234) == "12.3%" and measure("n").text(12345.6) == "12,346"
    assert Measure("t", np.array([1.0]), log, "ms").text(3.14159) == "3.14 ms"
