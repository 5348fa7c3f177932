"""Success of picks that are missed, on grids with a known answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.train.arrivals import normal_arrival
from datagen.train.evaluation.arrival_success import arrival_table
from datagen.train.evaluation.columns import Columns
from datagen.train.evaluation.evaluation import Method, weights_for
from tests.train.evaluation.made_columns import make_columns

SIDE = 13


def grids(label: np.ndarray, score: np.ndarray) -> Columns:
    """Four equal grids, all clear, cells in random order; label and score (SIDE, SIDE), rows along y."""
    rng, n = np.random.default_rng(0), SIDE * SIDE
    made = make_columns(rng, 4, n)
    axis = np.linspace(-1, 1, SIDE)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    order = np.concatenate([rng.permutation(n) for _ in range(4)])
    xy = np.stack([x.ravel(), y.ravel()], axis=1)[order].astype(np.float32)
    return replace(
        made,
        base_xy_m=xy,
        label=label.ravel()[order].astype(bool),
        is_clear=np.ones(len(made), bool),
        scores={"model": score.ravel()[order]},
    )


def test_a_lonely_good_cell_fails_where_a_wide_region_does_not() -> None:
    label = np.zeros((SIDE, SIDE))
    label[2, 2] = 1
    label[6:11, 6:11] = 1
    score = 0.8 * label
    score[2, 2] = 0.9
    columns = grids(label, score)
    found = arrival_table(
        columns, [Method("model", 0.5, gives_probabilities=True)], weights_for(columns, 20, 0)
    )
    at = {row["arrival"]: row["methods"]["model"] for row in found}
    assert at["0 m off"]["nominal"]["value"] == at["0 m off"]["smoothed"]["value"] == 1
    assert at["0.1 m off"]["nominal"]["value"] < 0.6
    assert at["0.1 m off"]["smoothed"]["value"] > 0.999
    np.testing.assert_allclose([row["best"] for row in found[:4]], 1)


def test_a_given_error_is_added_and_other_scores_enter_by_rank() -> None:
    label = np.zeros((SIDE, SIDE))
    label[6:11, 6:11] = 1
    distance = -np.hypot(*(np.indices((SIDE, SIDE)) - 8.0))
    columns = grids(label, distance)
    methods = [Method("model", float("nan"))]
    found = arrival_table(columns, methods, weights_for(columns, 20, 0), normal_arrival(0.05))
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
    columns = grids(label, score)
    method = Method("model", -2.0, chances=lambda s: np.interp(s, [-5, -1], [0.0, 1.0]))
    found = {
        row["arrival"]: row["methods"]["model"]
        for row in arrival_table(columns, [method], weights_for(columns, 20, 0))
    }
    assert found["0 m off"]["nominal"]["value"] == 1
    assert found["0.1 m off"]["nominal"]["value"] < 0.6  # of the highest score, though others have its chance
    assert found["0.1 m off"]["smoothed"]["value"] > 0.999
