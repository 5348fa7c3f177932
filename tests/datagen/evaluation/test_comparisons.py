"""Differences of methods over the same resampled scenes, and means over seeds of a training."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.evaluation.comparisons import Method, TrainedBy, by_recipe, mean_over_seeds
from datagen.evaluation.scores import evaluate_grids, evaluate_set, weights_for
from datagen.train.bootstrap import Estimate
from tests.datagen.evaluation.made_columns import make_columns

METRICS = ("accuracy", "balanced_accuracy", "mean_average_precision")


@given(st.integers(0, 2**32), st.integers(3, 20), st.floats(0, 1))
@settings(deadline=None, max_examples=15)
def test_swapping_methods_negates_the_difference_and_equal_ones_differ_by_zero(
    seed: int, n_scenes: int, skill: float
) -> None:
    rng = np.random.default_rng(seed)
    columns = make_columns(rng, n_scenes, per_scene=12)
    label = columns.label.copy()
    label[:2], columns.is_clear[:2] = [True, False], True
    scores = {name: label * share + (1 - share) * rng.random(len(label)) for name, share in
              (("late", skill), ("early", 0.3))}  # fmt: skip
    columns = replace(columns, label=label, scores={**scores, "same": scores["early"]})

    def differences(first: str, second: str) -> dict[str, dict[str, Any]]:
        methods = [
            Method(first, 0.5, TrainedBy("two-stage", "m")),
            Method(second, 0.5, TrainedBy("stage1", "m")),
        ]
        found = evaluate_set(columns, methods, "clear", weights_for(columns, 200, seed))["comparisons"]
        assert {(d["first"], d["second"], d["kind"]) for d in found} == {(first, second, "regimes")}
        return {d["metric"]: d for d in found}

    forth, back, none = (
        differences(*pair) for pair in (("late", "early"), ("early", "late"), ("early", "same"))
    )
    turned = {"above": "below", "below": "above", "open": "open"}
    for metric in METRICS:
        d, other = forth[metric], back[metric]
        assert [d[k] for k in ("value", "low", "high")] == pytest.approx(
            [-other[k] for k in ("value", "high", "low")]
        )
        assert d["low"] - 1e-9 <= d["value"] <= d["high"] + 1e-9 and d["verdict"] == turned[other["verdict"]]
        assert [none[metric][k] for k in ("value", "low", "high", "verdict")] == [0, 0, 0, "open"]


def test_regimes_are_compared_with_the_previous_and_the_best_model_with_the_best_baseline() -> None:
    columns = make_columns(np.random.default_rng(0), 30)
    rng = np.random.default_rng(1)
    made = {
        "plain": (0.2, TrainedBy()), "good plain": (0.3, TrainedBy()),
        "s1": (0.3, TrainedBy("stage1", "m")), "so": (0.4, TrainedBy("sim-only", "m")),
        "two a": (0.44, TrainedBy("two-stage", "m")), "two b": (0.48, TrainedBy("two-stage", "m")),
        "lone": (0.1, TrainedBy("stage1", "k")),
        "so quarter": (0.15, TrainedBy("sim-only", "m", 0.25)),
        "two quarter": (0.2, TrainedBy("two-stage", "m", 0.25)),
    }  # fmt: skip
    scores = {n: columns.label * s + (1 - s) * rng.random(len(columns)) for n, (s, _) in made.items()}
    columns = replace(columns, scores=scores)

    def pairs(*names: str) -> list[tuple[str, str, str]]:
        methods = [Method(name, 0.5, made[name][1]) for name in names]
        found = evaluate_set(columns, methods, "clear", weights_for(columns, 20, 0))["comparisons"]
        return [(d["kind"], d["first"], d["second"]) for d in found if d["metric"] == "accuracy"]

    found = pairs(*made)
    assert [pair for pair in found if pair[0] != "other"] == [
        ("regimes", "two a", "so"), ("regimes", "two b", "so"), ("regimes", "so", "s1"),
        ("regimes", "two quarter", "so quarter"),
        ("best", "two b", "good plain"),
    ]  # fmt: skip
    # Every two methods are compared once, a model minus a baseline.
    assert len({frozenset(pair[1:]) for pair in found}) == len(found) == 9 * 8 / 2
    assert ("other", "lone", "plain") in found and ("other", "plain", "good plain") in found
    # Without the regime between them two stages are held against the first.
    assert pairs("s1", "two a") == [("regimes", "two a", "s1")]


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
    assert by_recipe({"a": "", "b": "", "c": "r"}) == {}


def test_a_mean_of_perfect_seeds_keeps_the_exact_interval_of_a_share() -> None:
    perfect = Estimate(1.0, np.ones(50), trials=20)
    assert mean_over_seeds([perfect, perfect], np.zeros((50, 2), np.int64)).interval() == perfect.interval()


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
