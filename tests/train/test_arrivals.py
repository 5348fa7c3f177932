"""Arrival errors: their moments, maps smoothed by them, and texts that are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.arrivals import (
    disc_arrival,
    expected_success,
    normal_arrival,
    read_arrival,
    ring_arrival,
    tolerance_m,
)

STEP_M = 0.1


def test_moments_of_the_distributions() -> None:
    normal, disc, ring = normal_arrival(0.05, 0.1), disc_arrival(0.2, 0.25), ring_arrival(0.1)
    for arrival in (normal, disc, ring):
        np.testing.assert_allclose(arrival.offsets.mean(axis=0), 0, atol=1e-3)
    assert normal.offsets[:, 0].std() == pytest.approx(0.05, rel=0.1)
    assert normal.yaw_std_rad == pytest.approx(0.1, rel=0.1)
    assert disc.offsets[:, 1].std() == pytest.approx(0.2 / 2, rel=0.05)  # a uniform disc has R / 2
    np.testing.assert_allclose(np.hypot(*ring.offsets[:, :2].T), 0.1)


def test_smoothing_a_plane_keeps_it_and_an_edge_halves() -> None:
    y, x = np.indices((11, 11)).astype(float)
    smooth = expected_success(0.1 * x + y, STEP_M, normal_arrival(0.05))
    np.testing.assert_allclose(smooth[5, 5], 5.5, atol=1e-9)
    edge = (x >= 5).astype(float)
    half = expected_success(edge, STEP_M, ring_arrival(0.3))
    assert half[5, 5] == pytest.approx(0.55, abs=0.06) and half[5, 7] > 0.8 and half[5, 1] == 0
    np.testing.assert_allclose(expected_success(0.1 * x + y, STEP_M, ring_arrival(0.0)), 0.1 * x + y)
    assert expected_success(np.ones((7, 7)), STEP_M, ring_arrival(0.2))[0, 0] < 0.5  # off the map


def test_how_far_a_pose_may_be_missed() -> None:
    y, x = np.indices((21, 21)).astype(float)
    cone = np.clip(1 - np.hypot(x - 10, y - 10) * STEP_M, 0, 1)
    assert tolerance_m(cone, STEP_M, (10, 10), 0.7) == pytest.approx(0.29, abs=0.021)
    assert tolerance_m(cone, STEP_M, (10, 10), 2.0) == 0.0
    assert tolerance_m(np.ones((21, 21)), STEP_M, (10, 10), 0.5) == 0.5


@pytest.mark.parametrize(
    "text", ["normal:", "normal:x", "normal:-1", "disc:9", "normal:0.05,400deg", "normal:nan", "missing.csv"]
)
def test_what_is_no_distribution_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--arrival"):
        read_arrival(text)


def test_texts_of_arrivals() -> None:
    turning = read_arrival("normal:0.05,3deg").offsets
    np.testing.assert_array_equal(turning, normal_arrival(0.05, math.radians(3)).offsets)
    np.testing.assert_array_equal(read_arrival("nav2").offsets, disc_arrival(0.25, 0.25).offsets)
    assert read_arrival("normal:0.05").text == "normal, 0.05 m"
