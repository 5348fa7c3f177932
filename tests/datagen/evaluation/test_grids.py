"""Picks by brute force, and their success where the robot arrives off them, on grids with a known answer."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.evaluation.comparisons import Method
from datagen.evaluation.grids import arrival_table, picks, select
from datagen.evaluation.scores import weights_for
from datagen.train.arrivals import normal_arrival
from datagen.train.metrics import average_precision
from tests.datagen.evaluation.made_columns import make_columns, make_grids

SIDE = 13


@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 3))
@settings(deadline=None)
def test_selection_equals_brute_force(seed: int, side: int, levels: int) -> None:
    rng = np.random.default_rng(seed)
    n_groups, cells = 4, side * side
    group = rng.permutation(np.repeat(np.arange(n_groups), cells))
    xy = rng.uniform(-1, 1, (n_groups * cells, 2)).astype(np.float32)
    score = rng.choice([-np.inf, *range(levels)], len(group))
    true, allowed = rng.random(len(group)) < 0.3, rng.random(len(group)) < 0.6
    found = select(score, true, xy, group, allowed)
    row = 0
    for g in range(n_groups):
        members = [k for k in range(len(group)) if group[k] == g and allowed[k]]
        positives = [k for k in members if true[k]]
        if not positives:
            continue
        best = max(score[k] for k in members)
        tied = [k for k in members if score[k] == best]
        wrong = [min(np.hypot(*(xy[k] - xy[p])) for p in positives) for k in tied if not true[k]]
        assert found.group[row] == g
        assert found.good[row] == pytest.approx(1 - len(wrong) / len(tied))
        assert found.missed_m[row] == pytest.approx(np.mean(wrong) if wrong else 0, abs=1e-6)
        assert found.precision[row] == pytest.approx(average_precision(true[members], score[members]))
        row += 1
    assert row == len(found.group)


def test_ties_share_a_pick_and_nothing_allowed_picks_nothing() -> None:
    group = np.array([0, 0, 0, 1, 1, 2])
    share = picks(
        np.array([1.0, 1, 0, -np.inf, -np.inf, 5]), group, np.array([True, True, True, True, True, False])
    )
    assert share.tolist() == [0.5, 0.5, 0, 0.5, 0.5, 0]
    assert not picks(np.zeros(6), group, np.zeros(6, np.bool_)).any()


def test_a_scorer_that_knows_the_truth_never_misses() -> None:
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(20), 30)
    true, xy = rng.random(600) < 0.2, rng.uniform(-1, 1, (600, 2))
    found = select(true.astype(np.float64), true, xy, group, np.ones(600, np.bool_))
    assert (found.good == 1).all() and (found.missed_m == 0).all() and (found.precision == 1).all()
    worst = select(-true.astype(np.float64), true, xy, group, np.ones(600, np.bool_))
    assert (worst.good == 0).all() and (worst.missed_m > 0).all()
    # All good ones come last, with one score.
    assert worst.precision == pytest.approx(np.bincount(group, true) / 30)


def test_a_lonely_good_cell_fails_where_a_wide_region_does_not() -> None:
    label = np.zeros((SIDE, SIDE))
    label[2, 2] = 1
    label[6:11, 6:11] = 1
    score = 0.8 * label
    score[2, 2] = 0.9
    columns = make_grids(label, score)
    found = arrival_table(
        columns, [Method("model", 0.5, gives_probabilities=True)], weights_for(columns, 20, 0)
    )
    at = {row["arrival"]: row["methods"]["model"] for row in found}
    assert at["0 m off"]["nominal"]["value"] == at["0 m off"]["smoothed"]["value"] == 1
    assert at["0 m off"]["nominal"]["low"] == pytest.approx(0.025 ** (1 / columns.n_scenes))  # exact
    assert at["0.1 m off"]["nominal"]["value"] < 0.6
    assert at["0.1 m off"]["smoothed"]["value"] > 0.999
    np.testing.assert_allclose([row["best"] for row in found[:4]], 1)


def test_a_given_error_is_added_and_other_scores_enter_by_rank() -> None:
    label = np.zeros((SIDE, SIDE))
    label[6:11, 6:11] = 1
    distance = -np.hypot(*(np.indices((SIDE, SIDE)) - 8.0))
    columns = make_grids(label, distance)
    methods = [Method("model", float("nan"))]
    found = arrival_table(columns, methods, weights_for(columns, 20, 0), [normal_arrival(0.05)])
    assert found[-1]["arrival"] == "normal, 0.05 m"
    assert found[-1]["methods"]["model"]["smoothed"]["value"] > 0.99


def test_cells_that_are_no_whole_grid_have_no_table() -> None:
    columns = make_columns(np.random.default_rng(0), 3, 20)
    assert arrival_table(columns, [Method("random", 0.5)], weights_for(columns, 10, 0)) == []


def test_calibrated_scores_are_smoothed_as_chances_and_picked_as_they_are() -> None:
    # A lonely best cell, and a wide region of the same chance.
    label = np.zeros((SIDE, SIDE))
    label[2, 2] = 1
    label[6:11, 6:11] = 1
    score = np.where(label == 1, -1.0, -5.0)
    score[2, 2] = 0.0
    columns = make_grids(label, score)
    method = Method("model", -2.0, chances=lambda s: np.interp(s, [-5, -1], [0.0, 1.0]))
    found = {
        row["arrival"]: row["methods"]["model"]
        for row in arrival_table(columns, [method], weights_for(columns, 20, 0))
    }
    assert found["0 m off"]["nominal"]["value"] == 1
    assert found["0.1 m off"]["nominal"]["value"] < 0.6  # the highest score, though others have its chance
    assert found["0.1 m off"]["smoothed"]["value"] > 0.999
