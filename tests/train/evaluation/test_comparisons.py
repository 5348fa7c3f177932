"""Differences over the same resampled scenes, and which of them are asked for first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.train.evaluation.comparisons import Estimates, TrainedBy, comparisons
from datagen.train.evaluation.evaluation import Method, evaluate_set, weights_for
from tests.train.evaluation.made_columns import make_columns

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
              (("late", skill), ("early", 0.3), ("plain", 0.5))}  # fmt: skip
    columns = replace(columns, label=label, scores={**scores, "same": scores["early"]})
    origins = {
        "late": TrainedBy("two-stage", "m"),
        "early": TrainedBy("stage1", "m"),
        "same": TrainedBy("x", "m"),
    }

    def told(first: str, second: str) -> dict[str, dict[str, float]]:
        named = {first: origins["late"], second: origins["early"]}
        methods = [Method(name, 0.5, origin) for name, origin in named.items()]
        found = evaluate_set(columns, methods, "clear", weights_for(columns, 200, seed))
        assert [(d["first"], d["second"], d["kind"]) for d in found["comparisons"]] == [
            (first, second, "regimes")
        ] * 5
        return {d["metric"]: d for d in found["comparisons"]}

    forth, back, none = told("late", "early"), told("early", "late"), told("early", "same")
    for metric in METRICS:
        d, turned = forth[metric], back[metric]
        assert [d[k] for k in ("value", "low", "high")] == pytest.approx(
            [-turned[k] for k in ("value", "high", "low")]
        )
        assert d["low"] - 1e-9 <= d["value"] <= d["high"] + 1e-9
        assert [none[metric][k] for k in ("value", "low", "high", "verdict")] == [0, 0, 0, "open"]


def test_regimes_are_compared_with_the_previous_and_the_best_model_with_the_best_baseline() -> None:
    columns = make_columns(np.random.default_rng(0), 30)
    rng = np.random.default_rng(1)
    shares = {
        "plain": 0.2,
        "good plain": 0.3,
        "s1": 0.3,
        "so": 0.4,
        "two a": 0.44,
        "two b": 0.48,
        "lone": 0.1,
        "so quarter": 0.15,
        "two quarter": 0.2,
    }
    origins = {
        "plain": TrainedBy(), "good plain": TrainedBy(),
        "s1": TrainedBy("stage1", "m"), "so": TrainedBy("sim-only", "m"),
        "two a": TrainedBy("two-stage", "m"), "two b": TrainedBy("two-stage", "m"),
        "lone": TrainedBy("stage1", "k"),
        "so quarter": TrainedBy("sim-only", "m", 0.25), "two quarter": TrainedBy("two-stage", "m", 0.25),
    }  # fmt: skip
    scores = {n: columns.label * s + (1 - s) * rng.random(len(columns)) for n, s in shares.items()}
    columns = replace(columns, scores=scores)
    methods = [Method(name, 0.5, origin) for name, origin in origins.items()]
    found = evaluate_set(columns, methods, "clear", weights_for(columns, 200, 0))
    pairs = [(d["kind"], d["first"], d["second"]) for d in found["comparisons"] if d["metric"] == "accuracy"]
    assert pairs == [
        ("regimes", "two a", "so"), ("regimes", "two b", "so"), ("regimes", "so", "s1"),
        ("regimes", "two quarter", "so quarter"),
        ("best", "two b", "good plain"),
    ]  # fmt: skip
    every = {(d["metric"], d["first"], d["second"]): d for d in found["differences"]}
    for d in found["comparisons"]:
        low, high = d["low"], d["high"]
        if (other := every.get((d["metric"], d["second"], d["first"]))) is not None:
            assert (low, high) == pytest.approx((-other["high"], -other["low"]))
        else:
            other = every[d["metric"], d["first"], d["second"]]
            assert (low, high) == (other["low"], other["high"])
    # Without the regime between them two stages are held against the first.
    named = {n: o for n, o in origins.items() if n in ("s1", "two a")}
    estimates: Estimates = {n: {} for n in named}
    assert comparisons(estimates, named, ()) == []
    fewer = evaluate_set(
        columns, [Method(n, 0.5, o) for n, o in named.items()], "clear", weights_for(columns, 9, 0)
    )
    assert {(d["first"], d["second"]) for d in fewer["comparisons"]} == {("two a", "s1")}
