"""The estimator: against published formulas and another program, and by simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from datagen.estimation.rates import Population, RateEstimate, estimate_rate
from datagen.estimation.two_stage_sampling import draw_sample, in_proportion
from datagen.train.inputs import F64, Bools


def independent(n: int = 3000, n_dear: int = 400) -> Population:
    """Candidates alone in their scenes; the cheap label is right in four of five."""
    rng = np.random.default_rng(3)
    y = rng.random(n) < 0.3
    cheap = np.where(rng.random(n) < 0.8, y, ~y).astype(float)
    first = np.arange(n) < n_dear
    return Population(n, np.arange(n), cheap[:, None], first, y, np.full(n, n_dear / n))


def estimated(population: Population, member: F64 | None = None) -> RateEstimate:
    found = estimate_rate(population, np.ones(len(population.scene)) if member is None else member)
    assert found is not None
    return found


def test_it_is_prediction_powered_inference_where_units_are_independent() -> None:
    found = estimated(independent())
    # ppi-python 0.2.3 on the same numbers: ppi_mean_pointestimate and ppi_mean_ci with tuned lambda.
    rate, low, high = 0.29532919174321615, 0.25760720604697773, 0.33305117743945456
    se = (high - low) / 2 / stats.norm.ppf(0.975)
    assert abs(found.mixed.rate - rate) < 0.02 * se
    assert np.sqrt(found.mixed.variance) == pytest.approx(se, rel=0.01)


def test_the_rate_is_the_published_one_for_its_coefficient() -> None:
    population = independent()
    found, dear = estimated(population), population.is_dear
    y, f = population.label[dear].astype(float), population.cheap[:, 0]
    # Angelopoulos et al., arXiv 2311.01453, eq. 3: their second sum is over candidates without dear labels.
    coefficient = found.weights[0] * (~dear).mean()
    published = coefficient * f[~dear].mean() + (y - coefficient * f[dear]).mean()
    assert found.mixed.rate == pytest.approx(published, abs=1e-12)
    assert found.dear_alone.rate == y.mean()
    assert found.dear_alone.variance == pytest.approx(y.var(ddof=1) / len(y))


def test_the_coefficient_has_the_least_variance() -> None:
    found = estimated(independent())
    population = independent()
    f, y = population.cheap[population.is_dear, 0], population.label[population.is_dear]
    best = np.cov(f, y)[0, 1] / f.var(ddof=1)
    assert found.weights[0] == pytest.approx(best, rel=0.05)
    assert found.effective_labels > 1.3 * found.dear_labels


def test_cheap_labels_that_say_nothing_change_nothing() -> None:
    population = independent()
    found = estimated(replace(population, cheap=np.zeros_like(population.cheap)))
    assert found.weights == (0.0,) and found.mixed == found.dear_alone


def test_a_column_that_others_explain_is_left_out() -> None:
    population = independent()
    twice = estimated(replace(population, cheap=np.repeat(population.cheap, 2, axis=1)))
    assert twice.weights[1] == 0 and twice.mixed.rate == pytest.approx(estimated(population).mixed.rate)


def test_where_every_candidate_has_a_dear_label_its_rate_is_the_estimate() -> None:
    population = independent(n_dear=3000)
    found = estimated(population)
    assert found.mixed.rate == population.label.mean() and found.weights == (0.0,)


def test_without_a_positive_the_interval_is_exact() -> None:
    population = independent()
    found = estimated(replace(population, label=np.zeros(3000, np.bool_), cheap=np.zeros((3000, 1))))
    assert (found.mixed.rate, found.mixed.low) == (0, 0)
    assert found.mixed.high == pytest.approx(stats.beta.ppf(0.975, 1, 400))


def test_too_few_scenes_give_no_estimate() -> None:
    population = independent()
    assert estimate_rate(replace(population, is_dear=np.arange(3000) < 2), np.ones(3000)) is None


def test_few_scenes_leave_the_cheap_labels_out() -> None:
    population = independent()
    found = estimated(replace(population, is_dear=np.arange(3000) < 19))
    assert found.weights == (0.0,)


def test_the_growth_gives_the_wanted_half_width() -> None:
    population = independent()
    growth = estimated(population).growth(0.025)
    more = int(400 * growth)
    assert 1.5 < growth < 5
    rng = np.random.default_rng(0)
    chosen = np.zeros(3000, np.bool_)
    chosen[rng.choice(3000, more, replace=False)] = True
    grown = replace(population, is_dear=chosen, probability=np.full(3000, more / 3000))
    assert estimated(grown).mixed.half_width == pytest.approx(0.025, rel=0.1)
    assert estimated(population).growth(0.001) == np.inf  # 3,000 scenes are too few, whatever their labels
    assert estimated(population).growth(0.4) == 1


Design = Callable[[F64, np.random.Generator], tuple[Bools, F64]]
PER_SCENE = 12
TRUTH_OF = 200_000  # scenes whose rate is that of all


def draw(n: int, rng: np.random.Generator) -> tuple[Bools, F64, Bools]:
    """Labels, cheap labels and membership, (n, PER_SCENE) each, which a scene's candidates share in part."""
    ease = rng.beta(2, 2, n)[:, None]
    y = rng.random((n, PER_SCENE)) < ease
    cheap = np.where(rng.random(y.shape) < 0.85, y, ~y).astype(float)
    return y, cheap, rng.random(y.shape) < np.clip(ease + 0.2, 0, 1)


def whole_scenes(cheap: F64, rng: np.random.Generator) -> tuple[Bools, F64]:
    """Every candidate of 50 scenes."""
    n = len(cheap)
    chosen = np.isin(np.arange(n), rng.choice(n, 50, replace=False))
    return np.repeat(chosen[:, None], PER_SCENE, 1), np.full(cheap.shape, 50 / n)


def selected(cheap: F64, rng: np.random.Generator) -> tuple[Bools, F64]:
    """Four candidates of each of 120 scenes, more where cheap labels of a scene differ, a fifth at random."""
    mean = cheap.mean(axis=1, keepdims=True)
    size = np.broadcast_to(0.05 + mean * (1 - mean), cheap.shape)
    sample = draw_sample(in_proportion(size, 120, 4), 120, 4, 0.2, rng)
    chosen, probability = np.zeros(cheap.shape, np.bool_), np.ones(cheap.shape)
    at = sample.scene[:, None], sample.candidate
    chosen[at], probability[at] = True, sample.probability
    return chosen, probability


@pytest.mark.parametrize("design", [whole_scenes, selected])
def test_intervals_hold_the_truth_in_95_percent(design: Design) -> None:
    rng = np.random.default_rng(5)
    labels, _, members = draw(TRUTH_OF, rng)
    truth, held, alone, errors = labels[members].mean(), [], [], []
    widths: list[tuple[float, float]] = []
    for _ in range(1000):
        y, cheap, member = draw(400, rng)
        chosen, probability = design(cheap, rng)
        scene = np.repeat(np.arange(400), PER_SCENE)
        population = Population(
            400, scene, cheap.reshape(-1, 1), chosen.ravel(), y.ravel(), probability.ravel()
        )
        found = estimated(population, member.ravel().astype(float))
        held.append(found.mixed.low <= truth <= found.mixed.high)
        alone.append(found.dear_alone.low <= truth <= found.dear_alone.high)
        errors.append(found.mixed.rate - truth)
        widths.append((found.mixed.half_width, found.dear_alone.half_width))
    assert 0.93 <= np.mean(held) <= 0.97 and 0.93 <= np.mean(alone) <= 0.97
    assert (
        abs(np.mean(errors)) < 3 * np.std(errors) / np.sqrt(1000) + 0.002
    )  # ratios are biased by 1 / scenes
    narrower = np.array(widths).mean(axis=0)
    assert narrower[0] < 0.8 * narrower[1]
