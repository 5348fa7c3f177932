"""Mixtures, their points and intervals, and what stage 1 gains."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.frontier.cost_per_label import LabelCost
from datagen.frontier.mixtures import Mixture, Stage, mixtures_of, options_of
from datagen.frontier.points import TestSet, efficient, points_of
from datagen.frontier.study import study
from datagen.frontier.trainings import TrainingResult
from datagen.train.evaluation.metrics import area_under_roc
from datagen.train.inputs import F32

COSTS = {"heuristic": LabelCost(0.003, 1e-7), "plan": LabelCost(0.06, 2e-6)}
RNG = np.random.default_rng(2)
SCENES = 150
TEST = TestSet(RNG.random(SCENES * 10) < 0.6, np.repeat(np.arange(SCENES), 10))


def scores(quality: float, rng: np.random.Generator) -> F32:
    return (0.5 + quality * (TEST.label - 0.5) + rng.normal(0, 0.3, len(TEST.label))).astype(np.float32)


def result(quality: float, rng: np.random.Generator, **labels: int) -> TrainingResult:
    return TrainingResult(labels, scores(quality, rng), {"cost": {"train_cpu_s": 2.0}})


def test_mixtures_begin_with_what_is_cheaper_and_each_has_its_parent():
    found = mixtures_of(["sim", "heuristic", "plan"], (0.125, 0.25, 0.5, 1.0))
    assert len(found) == len(set(found)) == 3 * 4 + 3 * (4 + 2)
    names = list(dict.fromkeys(mixture.name for mixture in found))
    assert names[:5] == ["heuristic", "plan", "sim", "heuristic, plan", "25% heuristic, plan"]
    for mixture in found:
        assert mixture.before is None or mixture.before in found
    assert len(mixtures_of(["plan"], (1.0,))) == 1


def test_options_are_those_of_the_stage_with_fewer_epochs_for_more_labels():
    stages = Stage("heuristic", 1.0), Stage("plan", 1.0)
    first, alone, second = Mixture(stages[:1]), Mixture(stages[1:]), Mixture(stages)
    assert [options_of(m, 1000, 0, 16).stage for m in (first, alone, second)] == [
        "stage1",
        "sim-only",
        "stage2",
    ]
    assert [options_of(alone, n, 0, 16).epochs for n in (1000, 20_000, 10**6)] == [40, 10, 6]


def test_points_have_the_mean_of_the_seeds_and_intervals_over_seeds_and_scenes():
    rng = np.random.default_rng(3)
    alike = Mixture((Stage("plan", 0.5),))
    apart = Mixture((Stage("plan", 1.0),))
    same = result(0.4, rng, plan=600)
    results = {alike: [same] * 3, apart: [result(q, rng, plan=1200) for q in (0.2, 0.4, 0.6)]}
    points = points_of(results, TEST, COSTS, 300, 0)
    truth = np.mean([area_under_roc(TEST.label, r.scores.astype(np.float64)) for r in results[apart]])
    assert points[1].values["area_under_roc"].value == pytest.approx(truth)
    assert points[0].cpu_h == pytest.approx(600 * 0.06 / 3600) and points[1].money == pytest.approx(0.0024)
    widths = [np.ptp(point.values["area_under_roc"].interval()) for point in points]
    assert 0 < widths[0] < widths[1] / 2
    for point in points:
        for estimate in point.values.values():
            low, high = estimate.interval()
            assert low < estimate.value < high
            assert np.mean(estimate.resamples) == pytest.approx(estimate.value, abs=0.2 * (high - low))


def test_intervals_over_scenes_are_those_of_independent_test_sets():
    """The standard deviation of resamples is that of balanced accuracy over new draws of the test set."""
    rng = np.random.default_rng(4)
    mixture = Mixture((Stage("plan", 1.0),))
    drawn = []
    for _ in range(60):
        point = points_of({mixture: [result(0.4, rng, plan=1)]}, TEST, COSTS, 100, 0)[0]
        drawn.append(
            (point.values["balanced_accuracy"].value, np.std(point.values["balanced_accuracy"].resamples))
        )
    values, spreads = np.array(drawn).T
    assert np.mean(spreads) == pytest.approx(np.std(values), rel=0.3)


def test_a_point_is_on_the_frontier_where_nothing_cheaper_is_as_good():
    rng = np.random.default_rng(5)
    qualities = {0.125: 0.2, 0.5: 0.1, 1.0: 0.6}
    results = {
        Mixture((Stage("plan", share),)): [result(q, rng, plan=int(1000 * share))]
        for share, q in qualities.items()
    }
    points = points_of(results, TEST, COSTS, 20, 0)
    assert efficient(points, "area_under_roc") == [True, False, True]


def test_a_study_reports_what_stage_1_gains_and_foretells_the_largest_sets():
    """Quality grows with labels; stage 1 adds as much as 500 plan labels, and costs as much as 150."""
    rng = np.random.default_rng(6)
    sizes = {"heuristic": 3000, "plan": 4000}
    results: dict[Mixture, list[TrainingResult]] = {}
    for mixture in mixtures_of(list(sizes), (0.125, 0.25, 0.5, 1.0)):
        shares = {stage.source: stage.share for stage in mixture.stages}
        labels = {name: round(sizes[name] * share) for name, share in shares.items()}
        worth = labels.get("plan", 0) + 500 * shares.get("heuristic", 0) ** 0.5
        quality = 0.9 - 0.6 * (worth / 500) ** -0.5 if "plan" in shares else 0.1
        results[mixture] = [result(quality, rng, **labels) for _ in range(4)]
    points = points_of(results, TEST, COSTS, 60, 0)
    found = study(points, COSTS, 0.01, 0.95)
    gains = {round(gain.labels): gain for gain in found.stage1}
    assert list(gains) == [500, 1000, 2000, 4000]
    assert gains[500].same_labels.interval()[0] > 0.03
    assert gains[500].same_labels.value > gains[4000].same_labels.value + 0.02
    assert gains[500].same_cost is not None
    assert 0 < gains[500].same_cost.value < gains[500].same_labels.value
    assert found.stage1_worth is not None and 200 < found.stage1_worth.value < 1200
    assert {f.name for f in found.foretold} == {"plan", "heuristic, plan", "25% heuristic, plan"}
    for foretold in found.foretold:
        assert foretold.predicted.value == pytest.approx(foretold.measured.value, abs=0.03)
    assert found.advice is not None and found.advice.best == "plan"
    assert list(found.now) == [3000, 4000]
