"""Means over trainings that differ by their seed alone, and what their intervals hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.train.evaluation.bootstrap import Estimate
from datagen.train.evaluation.comparisons import TrainedBy
from datagen.train.evaluation.evaluation import Method, evaluate_grids, evaluate_set, weights_for
from datagen.train.evaluation.seeds import by_recipe, mean_over_seeds
from tests.train.evaluation.made_columns import make_columns


def test_methods_of_one_recipe_are_averaged_in_place_of_their_own_comparisons() -> None:
    rng = np.random.default_rng(5)
    columns = make_columns(rng, 40, per_scene=12)
    noise = {"a": 0.5, "b": 0.6, "other": 0.4, "plain": 0.7}
    scores = {n: columns.label * (1 - s) + s * rng.random(len(columns)) for n, s in noise.items()}
    columns = replace(columns, scores=scores)
    trained = TrainedBy("sim-only", "m")
    methods = [
        Method("a", 0.5, trained, recipe="r"), Method("b", 0.5, trained, recipe="r"),
        Method("other", 0.5, TrainedBy("stage1", "m"), recipe="s"), Method("plain", 0.5),
    ]  # fmt: skip
    weights = weights_for(columns, 200, 0)
    found = evaluate_set(columns, methods, "clear", weights)
    (mean,) = found["means"]
    assert (mean["name"], mean["of"]) == ("mean of 2 like a", ["a", "b"])
    for metric in ("balanced_accuracy", "area_under_roc", "accuracy"):
        of_each = [found["methods"][name][metric]["value"] for name in "ab"]
        assert mean[metric]["value"] == pytest.approx(np.mean(of_each))
        assert mean[metric]["low"] <= mean[metric]["value"] <= mean[metric]["high"]
    pairs = {(d["kind"], d["first"], d["second"]) for d in found["comparisons"]}
    assert ("regimes", "mean of 2 like a", "other") in pairs
    assert not {"a", "b"} & {name for _, *names in pairs for name in names}
    assert [m["name"] for m in evaluate_grids(columns, methods, weights)["means"]] == ["mean of 2 like a"]
    assert evaluate_set(columns, methods[1:], "clear", weights)["means"] == []


def test_a_mean_of_perfect_seeds_keeps_the_exact_interval_of_a_share() -> None:
    perfect = Estimate(1.0, np.ones(50), trials=20)
    assert mean_over_seeds([perfect, perfect], np.zeros((50, 2), np.int64)).interval() == perfect.interval()


def test_methods_without_a_recipe_are_never_averaged() -> None:
    assert by_recipe({"a": "", "b": "", "c": "r"}) == {}


@given(st.integers(0, 2**32), st.integers(2, 6), st.floats(0.01, 0.2))
@settings(deadline=None, max_examples=20)
def test_the_interval_of_a_mean_grows_with_the_spread_of_the_seeds(
    seed: int, n_seeds: int, spread: float
) -> None:
    rng = np.random.default_rng(seed)
    scenes = 0.8 + 0.01 * rng.standard_normal(4000)
    values = 0.8 + spread * rng.standard_normal(n_seeds)
    drawn = rng.integers(0, n_seeds, (4000, n_seeds))
    alike = mean_over_seeds([Estimate(0.8, scenes)] * n_seeds, drawn)
    np.testing.assert_allclose(alike.resamples, scenes)
    apart = mean_over_seeds([Estimate(v, scenes + v - 0.8) for v in values], drawn)
    assert apart.value == pytest.approx(values.mean())
    # The variance of scenes, and that of a mean of independent seeds.
    expected = np.sqrt(0.01**2 + values.var(ddof=1) / n_seeds)
    assert apart.resamples.std() == pytest.approx(expected, rel=0.15)
