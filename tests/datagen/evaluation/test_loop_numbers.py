"""Choices and rates of a closed loop, on grids with a known answer."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.evaluation.closed_loop import (
    candidates_of,
    draw_offsets,
    loop_table,
    pick_cells,
)
from datagen.evaluation.columns import Columns
from datagen.evaluation.comparisons import Method, TrainedBy
from datagen.evaluation.grids import AT_RANDOM, BY_LABELS, GridMaps, decisive_grids, grid_maps
from datagen.evaluation.scores import weights_for
from datagen.train.arrivals import ring_arrival
from datagen.train.inputs import F64
from tests.datagen.evaluation.made_columns import make_grids

SIDE, SCENES = 13, 4
STEP_M = 2 / (SIDE - 1)
ARRIVALS = tuple(ring_arrival(d) for d in (0.0, 0.05, 0.2))


def maps_of(columns: Columns) -> GridMaps:
    maps = grid_maps(columns)
    assert maps is not None
    return maps


def generators(scene: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng([scene, purpose])


def lonely_and_wide() -> tuple[F64, F64]:
    """A lonely good cell with the best score, and a region of good cells."""
    label = np.zeros((SIDE, SIDE))
    label[2, 2] = 1
    label[7:12, 7:12] = 1
    score = 0.8 * label
    score[2, 2] = 0.9
    return label, score


def test_a_smoothed_pick_is_inside_what_is_good_and_a_nominal_one_is_the_best_score() -> None:
    columns = make_grids(*lonely_and_wide())
    maps, methods = maps_of(columns), [Method("model", 0.5, gives_probabilities=True)]
    picked = pick_cells(columns, maps, methods, ARRIVALS, generators)
    lonely, middle = 2 * SIDE + 2, 9 * SIDE + 9
    assert (picked["model", "nominal"] == lonely).all()
    assert (picked["model", "smoothed"][0] == lonely).all()
    near = np.abs(np.array(np.divmod(picked["model", "smoothed"][2], SIDE)) - 9)
    assert near.max() <= 1
    assert (np.abs(picked[BY_LABELS, "smoothed"][2] - middle) <= SIDE + 1).all()
    assert (AT_RANDOM, "smoothed") not in picked
    # The candidate of a cell is its place in the scene as it is stored.
    first = np.arange(SCENES) * SIDE * SIDE
    for cells in picked.values():
        rows = candidates_of(maps, cells) + first
        xy = columns.base_xy_m[rows]
        at = np.stack(np.divmod(cells, SIDE)[::-1], axis=-1) * STEP_M - 1
        np.testing.assert_allclose(xy, at, atol=1e-6)


def test_arrivals_of_all_errors_lie_in_like_directions_and_spread() -> None:
    offsets = draw_offsets(ARRIVALS, 4, SCENES, generators)
    assert offsets.shape == (3, SCENES, 4, 3)
    assert not offsets[0].any() and not np.signbit(offsets).any(where=offsets == 0)
    np.testing.assert_allclose(offsets[2], 4 * offsets[1], atol=1e-5)
    angle = np.sort(np.arctan2(offsets[1, ..., 1], offsets[1, ..., 0]), axis=1)
    np.testing.assert_allclose(np.diff(angle, axis=1), np.pi / 2, atol=0.01)
    assert len(set(angle[:, 0].tolist())) > 1  # scenes begin elsewhere


def test_rates_are_means_over_scenes_with_their_causes_and_gains() -> None:
    columns = make_grids(*lonely_and_wide())
    decisive = decisive_grids(columns)
    assert decisive.all()  # 26 of 169 cells
    good, bad = ["success"] * 2, ["no_ik", "success"]
    nominal = np.array([[bad, bad, good, ["no_lift", "no_ik"]]], object)
    smoothed = np.array([[good, good, good, bad]], object)
    outcomes = {("model", "nominal"): nominal, ("model", "smoothed"): smoothed,
                ("plain", "nominal"): nominal, ("plain", "smoothed"): nominal}  # fmt: skip
    methods = [Method("model", 0.5, TrainedBy("two-stage", "shared")), Method("plain", 0.5)]
    weights = weights_for(columns, 200, 0)
    every = np.ones(SCENES, bool)
    (row,) = loop_table(outcomes, ARRIVALS[:1], methods, weights, every)
    assert row["methods"]["model"]["nominal"]["value"] == pytest.approx(0.5)
    assert row["methods"]["model"]["smoothed"]["value"] == pytest.approx(0.875)
    assert row["methods"]["model"]["nominal"]["failures"] == {"no_ik": 0.375, "no_lift": 0.125}
    assert row["gains"]["model"]["value"] == pytest.approx(0.375) and row["gains"]["plain"]["high"] == 0
    (best,) = row["comparisons"]
    assert (best["first"], best["second"]) == ("model", "plain") and best["value"] == pytest.approx(0.375)
    assert row["methods"]["model"]["smoothed"]["low"] < 0.875
    (half,) = loop_table(outcomes, ARRIVALS[:1], methods, weights, np.arange(SCENES) < 2)
    assert half["methods"]["model"]["nominal"]["value"] == pytest.approx(0.5)
    assert half["methods"]["model"]["smoothed"]["value"] == 1
