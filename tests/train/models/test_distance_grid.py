"""Distances in a box are those to the nearest cell with a point."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.train.models.distance_grid import FARTHEST, DistanceGrid

LOW_M, SHAPE, CELL_M = np.array([-0.3, -0.1, 0.0]), (30, 14, 9), 0.02
CENTRES_M = LOW_M + CELL_M * (np.argwhere(np.ones(SHAPE)) + 0.5)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 40))
def test_distances_are_those_of_every_pair_of_cells(seed: int, count: int):
    held = CENTRES_M[np.random.default_rng(seed).integers(0, len(CENTRES_M), count)]
    grid = DistanceGrid(held, LOW_M, SHAPE, CELL_M)
    each = np.linalg.norm(CENTRES_M[:, None] - held, axis=2).min(1)
    np.testing.assert_allclose(grid(CENTRES_M, -1), np.minimum(each, FARTHEST * CELL_M), atol=1e-6)


def test_points_outside_and_points_that_are_no_numbers_are_left_out():
    bad = np.array([[np.nan, 0, 0], [np.inf, 0, 0.01], [5.0, 0.0, 0.0], [0.0, 0.0, -0.01]])
    grid = DistanceGrid(bad, LOW_M, SHAPE, CELL_M)
    assert np.ptp(grid(CENTRES_M, -1)) == 0
    np.testing.assert_array_equal(grid(CENTRES_M[:1] + 1.0, 0.1), np.array([0.1], np.float32))
