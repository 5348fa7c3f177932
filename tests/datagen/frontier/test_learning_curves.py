"""Curves find the law that points follow, and purchases follow the curves."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.frontier.advice_text import advice_text, target_text
from datagen.frontier.buyer import advise, cheapest
from datagen.frontier.cost_per_label import LabelCost
from datagen.frontier.learning_curves import CurveForm, LearningCurve, fit_curve

N0, H0 = 10_000.0, 60_000.0


def curve_of(form: CurveForm, theta: list[float], spread: float = 0.0, resamples: int = 20) -> LearningCurve:
    rng = np.random.default_rng(0)
    drawn = np.array(theta) + spread * rng.standard_normal((resamples, len(theta)))
    return LearningCurve(form, np.array(theta), drawn, 0.0)


def test_a_power_law_is_found_again_and_extrapolated():
    form = CurveForm(1, False, N0)
    theta = np.array([0.08, 0.07, np.log(0.4)])
    labels = np.array([[1250.0], [2500.0], [5000.0], [10_000.0]])
    exact = 1 - form.error(theta, labels)
    rng = np.random.default_rng(1)
    noisy = exact + 0.002 * rng.standard_normal((60, 4))
    curve = fit_curve(form, labels, exact, noisy)
    assert curve is not None and curve.residual < 0.002
    predicted, resampled = curve.accuracy(np.array([[20_000.0]]))
    truth = float(1 - form.error(theta, np.array([20_000.0])))
    assert predicted[0] == pytest.approx(truth, abs=0.006)
    low, high = np.quantile(resampled[:, 0], [0.025, 0.975])
    assert low < truth < high


def test_the_worth_of_other_sources_is_found_again():
    """One trial is worth three plans, and all heuristic labels 2,000 plans."""
    form = CurveForm(2, True, N0, H0)
    theta = np.array([0.05, 0.08, np.log(0.5), np.log(3.0), 0.2, 0.5])
    labels = np.array(
        [[h, p, s] for h in (0.0, 15_000, 60_000) for p in (1250.0, 5000, 10_000) for s in (0.0, 1000, 3000)]
    )
    exact = 1 - form.error(theta, labels)
    curve = fit_curve(form, labels, exact, exact[None])
    assert curve is not None
    trials = curve.form.effective(curve.theta, np.array([0.0, 0.0, 1000.0]))
    heuristic = curve.form.effective(curve.theta, np.array([H0, 0.0, 0.0]))
    assert trials == pytest.approx(3000, rel=0.15) and heuristic == pytest.approx(2000, rel=0.15)
    quarter = curve.form.effective(curve.theta, np.array([H0 / 4, 0.0, 0.0]))
    assert quarter == pytest.approx(1000, rel=0.2)
    assert curve.form.effective(curve.theta, np.array([0.0, 7.0, 0.0])) == pytest.approx(7)


def test_two_points_are_no_curve():
    form = CurveForm(1, False, N0)
    assert fit_curve(form, np.array([[1.0], [2.0]]), np.array([0.5, 0.6]), np.zeros((3, 2))) is None


COSTS = {name: LabelCost(cpu_s, 0.0) for name, cpu_s in (("heuristic", 0.003), ("plan", 0.06), ("sim", 0.12))}
SOURCES = ("heuristic", "plan", "sim")
NOW = np.array([H0, N0, 1000.0])


def test_the_source_that_gains_most_for_its_cost_is_bought():
    form = CurveForm(2, True, N0, H0)
    three = curve_of(form, [0.05, 0.08, np.log(0.5), np.log(3.0), 0.05, 0.5])  # for twice the price
    advice = advise(three, SOURCES, NOW, COSTS, 1.0)
    assert advice.best == "sim" and advice.wins["sim"] == 1
    assert advice.alone["sim"].labels == {"sim": 30_000} and advice.alone["plan"].labels == {"plan": 60_000}
    assert advice.split.labels == {"sim": 30_000}
    one = curve_of(form, [0.05, 0.08, np.log(0.5), np.log(1.0), 0.05, 0.5])
    assert advise(one, SOURCES, NOW, COSTS, 1.0).best == "plan"


def test_the_advice_says_how_sure_it_is():
    form = CurveForm(2, True, N0, H0)
    unsure = curve_of(form, [0.05, 0.08, np.log(0.5), np.log(2.0), 0.05, 0.5], spread=0.03, resamples=400)
    advice = advise(unsure, SOURCES, NOW, COSTS, 2.0)
    assert 0.2 < advice.wins["plan"] < 0.8 and sum(advice.wins.values()) == pytest.approx(1)
    text = advice_text(advice, 2.0)
    assert f"the best choice in {advice.wins[advice.best]:.0%} of 400 resamples" in text
    assert text.startswith("Spend the next 2 core-hours on")


def test_a_flat_curve_buys_nothing():
    flat = curve_of(CurveForm(1, False, N0), [0.1, 0.0, np.log(0.5)])
    advice = advise(flat, ("plan",), np.array([N0]), COSTS, 1.0)
    assert advice.wins == {"plan": 0.0, "nothing": 1.0}
    assert "gain nothing that can be measured" in advice_text(advice, 1.0)


def test_a_target_costs_what_the_curve_says():
    form = CurveForm(1, False, N0)
    curve = curve_of(form, [0.05, 0.08, np.log(0.5)])
    # error 0.09: m = 4 N0, so 3 N0 more labels of 0.06 s.
    target = cheapest(curve, ("plan",), np.array([N0]), COSTS, 0.91)
    needed = 3 * N0 * 0.06 / 3600
    for reached in (target.reached_by_half, target.reached_by_most):
        assert reached is not None and needed <= reached.cpu_h <= 1.13 * needed
    assert "91.0% is reached in half of the resamples with 0.5" in target_text(target, curve)
    beyond = cheapest(curve, ("plan",), np.array([N0]), COSTS, 0.96)
    assert beyond.reached_by_half is None
    assert "the median of the curve's limits is 95.0%" in target_text(beyond, curve)
