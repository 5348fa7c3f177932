"""Agreement of labels, on small arrays whose answers are counted by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.reports.agreement import (
    REACH_EDGES_M,
    Labelled,
    agreement,
    common_candidates,
    compare,
    confusion,
    join_labelled,
    outcome_report,
)
from datagen.schemas.outcomes import OUTCOMES
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS, DISTANCE_EDGES_M, VISIBILITY_EDGES, bands

CODES = {name: code for code, name in enumerate(OUTCOMES)}


def bools(*values: int) -> np.ndarray:
    return np.array(values, np.bool_)


def labelled(label: list[int], **columns: Any) -> Labelled:
    """One scene's candidates, all clear, half a metre off and in full view unless said otherwise."""
    n = len(label)
    given: dict[str, Any] = {
        "scene": np.zeros(n, np.int64),
        "candidate": np.arange(n, dtype=np.int32),
        "label": np.array(label, np.bool_),
        "is_clear": np.ones(n, np.bool_),
        "target": np.array(["mug"] * n, object),
        "furniture": np.array(["Desk"] * n, object),
        "edge_xy_m": np.tile([0.0, -0.5], (n, 1)),
        "outcome": None,
    }
    for name, value in (("distance_m", 0.5), ("mount_distance_m", 0.6), ("visibility", 1.0)):
        given[name] = np.full(n, value, np.float32)
    for name, value in (("reach_m", 0.7), ("height_m", 0.8)):
        given[name] = np.full(n, value, np.float32)
    arrays = {"distance_m", "mount_distance_m", "visibility", "reach_m", "height_m"}
    for name, value in columns.items():
        given[name] = np.array(value, np.float32) if name in arrays else np.array(value)
    return Labelled(**given)


def test_confusion_and_accuracies_of_counted_labels() -> None:
    said, true = bools(1, 1, 1, 0, 0, 0, 0, 0), bools(1, 1, 0, 1, 0, 0, 0, 0)
    assert confusion(said, true) == {
        "true_positive": 2, "false_positive": 1, "false_negative": 1, "true_negative": 4
    }  # fmt: skip
    counted = agreement(said, true)
    assert (counted["count"], counted["said_positive"]) == (8, 3)
    assert counted["true_positive_share"] == 3 / 8 and counted["accuracy"] == 6 / 8
    assert counted["balanced_accuracy"] == pytest.approx((2 / 3 + 4 / 5) / 2)


@given(st.lists(st.booleans(), min_size=2, max_size=50))
def test_a_rule_that_looks_at_nothing_has_balanced_accuracy_one_half(truth: list[bool]) -> None:
    true = np.array(truth)
    for said in (np.zeros_like(true), np.ones_like(true)):
        value = agreement(said, true)["balanced_accuracy"]
        assert value == (0.5 if 0 < true.sum() < len(true) else None)


def test_nothing_is_said_of_no_candidates() -> None:
    nothing = agreement(bools(), bools())
    assert nothing["count"] == 0 and nothing["accuracy"] is None and nothing["balanced_accuracy"] is None
    empty = labelled([], outcome=np.zeros(0, np.uint8))
    assert compare(empty, empty)["by_distance"] == [] == outcome_report(empty)["outcomes"]


@given(st.lists(st.floats(0, 2, width=32), max_size=60))
def test_every_value_lies_in_exactly_one_band(values: list[float]) -> None:
    array = np.array(values, np.float32)
    for edges in (DISTANCE_EDGES_M, REACH_EDGES_M, VISIBILITY_EDGES):
        times = sum((rows.astype(int) for _, _, rows in bands(array, edges)), np.zeros(len(array), int))
        assert (times == 1).all()


def test_stored_lengths_on_an_edge_belong_to_the_band_that_begins_there() -> None:
    reaches = np.array([0.3, 0.7, 1.0], np.float32)
    assert [(low, high) for low, high, _ in bands(reaches, REACH_EDGES_M)] == [
        (0.3, 0.4), (0.7, 0.8), (1.0, None)
    ]  # fmt: skip


def test_candidate_sets_are_nested() -> None:
    side = labelled([0] * 4, is_clear=bools(1, 1, 0, 0), mount_distance_m=[0.7, 0.71, 0.5, 2.0])
    counts = [side.is_in(name).tolist() for name in reversed(CANDIDATE_SETS)]
    assert counts == [[True] * 4, [True, True, False, False], [True, False, False, False]]


def test_only_what_both_labelled_is_compared_whatever_the_order() -> None:
    a = labelled([1, 0, 1, 0], scene=np.array([0, 0, 1, 1]), candidate=np.array([0, 1, 0, 1], np.int32))
    b = labelled([1, 1, 0], scene=np.array([1, 2, 0]), candidate=np.array([0, 0, 1], np.int32))
    left, right = common_candidates(a, b)
    pairs = [(side.scene.tolist(), side.candidate.tolist(), side.label.tolist()) for side in (left, right)]
    assert pairs == [([0, 1], [1, 0], [False, True])] * 2


def test_groups_have_their_own_counts() -> None:
    columns: dict[str, Any] = {
        "distance_m": [0.35, 0.39, 0.4, 1.2],
        "visibility": [0.0, 0.03999, 0.04, 1.0],
        "reach_m": [0.5, 0.5, 0.9, 0.9],
        "target": np.array(["mug", "bowl", "mug", "mug"], object),
    }
    outcome = np.array([CODES[o] for o in ("success", "no_ik", "no_ik", "dropped")], np.uint8)
    said, true = labelled([1, 1, 0, 0], **columns), labelled([1, 0, 0, 0], outcome=outcome, **columns)
    compared = compare(said, true)
    assert [(g["low"], g["high"], g["count"], g["accuracy"]) for g in compared["by_distance"]] == [
        (0.3, 0.4, 2, 0.5), (0.4, 0.5, 1, 1.0), (1.0, None, 1, 1.0)
    ]  # fmt: skip
    assert [g["count"] for g in compared["by_visibility"]] == [2, 1, 1]
    assert [(g["low"], g["count"], g["said_positive"]) for g in compared["by_reach"]] == [
        (0.5, 2, 2), (0.9, 2, 0)
    ]  # fmt: skip
    assert [(g["object"], g["count"], g["accuracy"]) for g in compared["by_object"]] == [
        ("bowl", 1, 0.0), ("mug", 3, 1.0)
    ]  # fmt: skip
    counted = [(o["outcome"], o["count"], o["said_positive"], o["accuracy"]) for o in compared["by_outcome"]]
    assert counted == [("success", 1, 1, 1.0), ("no_ik", 2, 1, 0.5), ("dropped", 1, 0, 1.0)]
    assert compare(true, said)["by_outcome"] == []  # labels without a cause


def test_outcomes_are_counted_with_the_stage_that_decided_them() -> None:
    names = ["success", "no_ik", "no_path", "no_lift", "dropped"]
    outcome = np.array([CODES[name] for name in names], np.uint8)
    two = [labelled([1, 0, 0, 0, 0], outcome=outcome, distance_m=[0.5, 0.5, 0.6, 0.6, 0.6])] * 2
    report = outcome_report(join_labelled(two))
    assert report["count"] == 10
    assert [(o["outcome"], o["count"], o["share"]) for o in report["outcomes"]] == [
        (name, 2, 0.2) for name in names
    ]
    assert {s["stage"]: s["count"] for s in report["failures_by_stage"]} == {"ik": 2, "path": 4, "execute": 2}
    assert report["positive_by"]["distance"] == [
        {"low": 0.5, "high": 0.6, "count": 4, "positive": 2},
        {"low": 0.6, "high": 0.7, "count": 6, "positive": 0},
    ]
