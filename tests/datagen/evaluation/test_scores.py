"""Numbers of a candidate set and of whole grids, against counts by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from datagen.evaluation.columns import Columns
from datagen.evaluation.comparisons import Method, TrainedBy
from datagen.evaluation.scores import evaluate_grids, evaluate_set, weights_for
from datagen.schemas.errors import InputError
from tests.datagen.evaluation.made_columns import make_columns

METHODS = [
    Method("truth", 0.5),
    Method("constant", 0.5),
    Method("noisy", 0.5, TrainedBy("stage1", "paper"), gives_probabilities=True),
    Method("nearest", float("nan")),
]


def scored(seed: int = 0, **changes: Any) -> Columns:
    rng = np.random.default_rng(seed)
    columns = make_columns(rng, **changes)
    n = len(columns)
    scores = {
        "truth": columns.label.astype(np.float64),
        "constant": np.full(n, 0.7),
        "noisy": np.clip(columns.label * 0.4 + rng.random(n) * 0.6, 0, 1),
        "nearest": -columns.mount_distance_m.astype(np.float64),
    }
    return replace(columns, scores=scores)


def test_numbers_of_a_set_equal_counts_by_hand() -> None:
    columns = scored(n_scenes=40)
    told = evaluate_set(columns, METHODS, "clear", weights_for(columns, 200, 0))
    rows = columns.is_clear
    label, said = columns.label[rows], columns.scores["noisy"][rows] >= 0.5
    assert (told["count"], told["positives"], told["scenes"]) == (rows.sum(), label.sum(), 40)
    noisy = told["methods"]["noisy"]
    assert noisy["accuracy"]["value"] == pytest.approx((said == label).mean())
    assert noisy["accuracy"]["low"] < noisy["accuracy"]["value"] < noisy["accuracy"]["high"]
    reached = columns.is_reachable[rows]
    assert noisy["accuracy_in_reach"]["value"] == pytest.approx((said == label)[reached].mean())
    assert noisy["accuracy_out_of_reach"]["value"] == pytest.approx((said == label)[~reached].mean())
    assert told["out_of_reach"] == {"count": int((~reached).sum()), "positives": 0}
    assert told["methods"]["truth"]["accuracy"] == {"value": 1, "low": 1, "high": 1}
    constant = told["methods"]["constant"]
    assert (
        constant["balanced_accuracy"] == constant["area_under_roc"] == {"value": 0.5, "low": 0.5, "high": 0.5}
    )
    assert constant["accuracy"]["value"] == pytest.approx(label.mean())
    sure = [d for d in told["comparisons"] if {d["first"], d["second"]} == {"truth", "constant"}]
    assert {d["verdict"] for d in sure if d["metric"] == "accuracy"} == {"above"}
    json.dumps(told, allow_nan=False)


def test_a_method_without_threshold_labels_only_its_pick_positive() -> None:
    columns = scored(n_scenes=30)
    told = evaluate_set(columns, METHODS, "in-range", weights_for(columns, 50, 0))
    cut = columns.at(columns.is_in("in-range"))
    right = 0
    for scene in range(30):
        rows = np.flatnonzero(cut.scene == scene)
        if len(rows):
            pick = rows[np.argmin(cut.mount_distance_m[rows])]
            right += sum(bool(cut.label[row]) == (row == pick) for row in rows)
    assert told["methods"]["nearest"]["accuracy"]["value"] == pytest.approx(right / len(cut))


def test_only_probabilities_have_a_calibration() -> None:
    columns = scored()
    methods = evaluate_set(columns, METHODS, "clear", weights_for(columns, 10, 0))["methods"]
    assert methods["noisy"]["brier"] > 0 and methods["noisy"]["expected_calibration_error"] > 0
    # A number in [0, 1] is a probability only where the method says so.
    assert [methods[name]["brier"] for name in ("truth", "constant", "nearest")] == [None, None, None]


def test_numbers_of_grids_equal_counts_by_hand() -> None:
    columns = scored(n_scenes=60, per_scene=9)
    label = columns.label & (columns.scene % 4 != 0)
    columns = replace(columns, label=label, scores={**columns.scores, "truth": label.astype(np.float64)})
    some = np.unique(columns.scene[label])
    told = evaluate_grids(columns, METHODS, weights_for(columns, 200, 0))
    assert told["scenes"] == 60 and told["scenes_without_positive"] == 60 - len(some)
    # A chance of `low` gives as many good picks in a row once in forty times.
    sure = told["methods"]["truth"]["good"]
    assert (sure["value"], sure["high"]) == (1, 1) and sure["low"] ** len(some) == pytest.approx(0.025)
    assert told["methods"]["truth"]["missed_m"]["value"] is None
    # A constant picks any clear candidate.
    shares = [label[rows].mean() for s in some if (rows := (columns.scene == s) & columns.is_clear).any()]
    assert told["methods"]["constant"]["good"]["value"] == pytest.approx(np.mean(shares))
    assert told["any_clear"] == pytest.approx(np.mean(shares))
    missed: list[float] = []
    for s in some:
        rows = np.flatnonzero((columns.scene == s) & columns.is_clear)
        pick = rows[np.argmax(columns.scores["noisy"][rows])]
        if not label[pick]:
            goods = columns.base_xy_m[rows[label[rows]]]
            missed.append(float(np.linalg.norm(goods - columns.base_xy_m[pick], axis=1).min()))
    found = told["methods"]["noisy"]
    assert told["methods"]["truth"]["mean_average_precision"]["value"] == 1
    # Where no score tells candidates apart each threshold is the share of good ones.
    constant = told["methods"]["constant"]["mean_average_precision"]
    assert constant["value"] == pytest.approx(np.mean(shares))
    assert constant["value"] < found["mean_average_precision"]["low"] < 1
    assert found["good"]["value"] == pytest.approx(1 - len(missed) / len(some))
    assert found["missed_m"]["value"] == pytest.approx(np.mean(missed))


def test_sets_without_candidates_or_with_one_class_are_refused() -> None:
    columns = scored()
    weights = weights_for(columns, 10, 0)
    nothing = replace(columns, is_clear=np.zeros(len(columns), np.bool_))
    with pytest.raises(InputError, match="--candidates: clear: has no candidate of these runs"):
        evaluate_set(nothing, METHODS, "clear", weights)
    bad = replace(columns, label=np.zeros(len(columns), np.bool_))
    with pytest.raises(InputError, match="grid: all 240 candidates have the label 0"):
        evaluate_set(bad, METHODS, "grid", weights)
