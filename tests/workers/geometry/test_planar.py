"""Planar geometry against brute force and known shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from datagen.workers.geometry.planar import (
    convex_hull,
    inside_any,
    inside_polygon,
    polygons_at,
    signed_distances_between,
    signed_distances_to_convex,
    stack_polygons,
)

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
coordinates = st.floats(-5, 5, width=32)


def test_distance_to_a_rectangle_is_known() -> None:
    points = np.array([[1.0, 0.5], [1.0, 2.0], [3.0, 2.0], [2.0, 0.5], [0.1, 0.5]])
    distance = signed_distances_to_convex(points, SQUARE[None])[:, 0]
    np.testing.assert_allclose(distance, [-0.5, 1.0, np.sqrt(2), 0.0, -0.1], atol=1e-12)


@given(arrays(np.float64, (12, 2), elements=coordinates), arrays(np.float64, (9, 2), elements=coordinates))
def test_sign_of_the_distance_agrees_with_containment(cloud: np.ndarray, points: np.ndarray) -> None:
    hull = convex_hull(cloud)
    if len(hull) < 3:
        return
    distance = signed_distances_to_convex(points, hull[None])[:, 0]
    sure = np.abs(distance) > 1e-6
    assert (inside_polygon(points, hull)[sure] == (distance < 0)[sure]).all()


@given(arrays(np.float64, (8, 2), elements=coordinates), arrays(np.float64, (5, 2), elements=coordinates))
def test_distance_is_never_more_than_to_any_sampled_border_point(
    cloud: np.ndarray, points: np.ndarray
) -> None:
    hull = convex_hull(cloud)
    t = np.linspace(0, 1, 17)[:, None, None]
    border = (hull[None] * (1 - t) + np.roll(hull, -1, axis=0)[None] * t).reshape(-1, 2)
    sampled = np.linalg.norm(points[:, None] - border[None], axis=2).min(1)
    distance = np.abs(signed_distances_to_convex(points, hull[None])[:, 0])
    assert (distance <= sampled + 1e-9).all()
    spacing = np.linalg.norm(np.roll(hull, -1, axis=0) - hull, axis=1).max() / 16
    assert (distance >= sampled - spacing).all()


@given(
    arrays(np.float64, (6, 2), elements=coordinates),
    arrays(np.float64, (7, 2), elements=coordinates),
    st.integers(1, 7),
    st.floats(-7, 7),
)
def test_the_distance_of_polygons_is_that_of_the_origin_from_their_difference(
    first: np.ndarray, second: np.ndarray, corners: int, yaw_rad: float
) -> None:
    """By Minkowski: one is moved out of the other by what moves all differences of points off the origin."""
    one, other = convex_hull(first), convex_hull(second[:corners])  # also a segment or a point
    if len(one) < 3 or not np.ptp(one, axis=0).min() > 1e-3:
        return
    one = polygons_at(one, np.array([[0.3, -0.2]]), np.array([yaw_rad]))[0]
    apart = convex_hull((other[:, None] - one[None]).reshape(-1, 2))
    wanted = signed_distances_to_convex(np.zeros((1, 2)), apart[None])[0, 0]
    pair = stack_polygons([other, np.zeros((9, 2))])[0]  # padded
    found = signed_distances_between(one[None], pair[None])[0]
    assert found == pytest.approx(wanted, abs=1e-6)
    both = signed_distances_between(np.stack([one, one]), np.stack([pair, pair + 20.0]))
    assert both[0] == pytest.approx(found, abs=1e-12) and both[1] > 0


def test_padding_does_not_change_distances() -> None:
    triangle = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    points = np.random.default_rng(0).uniform(-1, 3, (50, 2))
    together = signed_distances_to_convex(points, stack_polygons([triangle, SQUARE]))
    apart = [signed_distances_to_convex(points, p[None])[:, 0] for p in (triangle, SQUARE)]
    np.testing.assert_array_equal(together, np.stack(apart, axis=1))


@pytest.mark.parametrize("points", [[[0, 0], [1, 1], [2, 2]], [[1, 1], [1, 1], [1, 1]]])
def test_hull_of_points_without_area_is_a_segment_without_inside(points: list[list[float]]) -> None:
    hull = convex_hull(np.array(points, np.float64))
    assert hull.shape == (2, 2)
    assert (signed_distances_to_convex(np.array([[1.0, 1.0]]), hull[None]) >= 0).all()


def test_containment_in_an_l_shaped_room() -> None:
    room = np.array([[0, 0], [4, 0], [4, 2], [2, 2], [2, 4], [0, 4]], np.float64)
    points = np.array([[1, 1], [3, 1], [1, 3], [3, 3], [5, 1]], np.float64)
    assert inside_polygon(points, room).tolist() == [True, True, True, False, False]
    assert inside_any(points, [room, room + 1.5]).tolist() == [True, True, True, True, False]
