"""Outlines of bases: what lies in them, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.prediction.base_cells import crowded_bases
from datagen.train.prediction.footprints import Footprint, circle_footprint, polygon_footprint, read_footprint

LONG = ((0.2, 0.1), (-0.6, 0.1), (-0.6, -0.1), (0.2, -0.1))


def test_a_polygon_holds_points_of_its_own_frame_and_turns_with_the_base() -> None:
    base = polygon_footprint(LONG)
    points = np.array([[0.19, 0.0], [-0.59, 0.09], [0.21, 0.0], [0.0, 0.11]])
    assert base.holds(points).tolist() == [True, True, False, False]
    np.testing.assert_allclose(base.middle_m, [-0.2, 0.0])
    assert base.radius_m == pytest.approx(np.hypot(0.6, 0.1))
    assert base.turning_radius_m == pytest.approx(np.hypot(0.4, 0.1))
    assert base.width_m == pytest.approx(0.1)
    turned = base.outline(np.array([1.0, 2.0]), np.pi / 2)
    np.testing.assert_allclose(turned[1], [1 - 0.1, 2 - 0.6], atol=1e-12)
    corners = [(0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3), (0.3, -0.1), (0.1, 0.0), (0.3, 0.1)]
    notched = polygon_footprint(corners)
    assert notched.holds(np.array([[0.25, 0.0], [0.25, 0.2], [-0.2, 0.0]])).tolist() == [False, True, True]


def test_texts_and_robots() -> None:
    assert read_footprint("0.3") == read_footprint(0.3) == circle_footprint(0.3)
    assert (
        read_footprint("0.2,0.1;-0.6,0.1;-0.6,-0.1;0.2,-0.1")
        == read_footprint(LONG)
        == polygon_footprint(LONG)
    )
    fetch = read_footprint("fetch")
    assert 0.31 < fetch.radius_m < 0.33 and fetch.middle_m[0] == pytest.approx(-0.033, abs=2e-3)
    assert isinstance(fetch, Footprint) and read_footprint(fetch) is fetch


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("0", "radius"),
        ("nan", "radius"),
        ("9", "radius"),
        ("wide", "not a footprint"),
        ("panda", "pedestal"),
        ("0.1,0.1;0.2,0.2", "3 to 256 corners"),
        ("0.1,0.1;0.2;0.3,0.3", "3 to 256 corners"),
        ("30,20;-30,20;-30,-20;30,-20", "farther than"),
        ("0.3,0.2;-0.3,-0.2;0.3,-0.2;-0.3,0.2", "crosses itself"),
        ("0.3,0;-0.3,0;0.1,0", "no area"),
        ("0.3,0.2;0.1,0.2;0.1,-0.2;0.3,-0.2", "hold the arm's mount"),
    ],
)
def test_what_is_no_base_is_refused(given: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_footprint(given)


@pytest.mark.parametrize("given", ["0.25", "-0.1,-0.2;0.5,-0.2;0.5,0.2;0.1,0.2;0.1,0.05;-0.1,0.2", "fetch"])
def test_bases_with_points_inside_are_those_of_a_count_one_by_one(given: str) -> None:
    base, rng = read_footprint(given), np.random.default_rng(3)
    bases, yaw = rng.uniform(-1, 1, (300, 2)), rng.uniform(-np.pi, np.pi, 300)
    # In the middles of cells of a centimetre, in which points are counted; some cells hold several.
    cells = rng.integers(180, 420, (70, 2))
    xy = bases.mean(axis=0) - 3.0 + 0.01 * (np.concatenate([cells, cells[:20], cells[:10]]) + 0.5)
    points = np.insert(xy, 2, 0.2, axis=1).astype(np.float32)
    turns = np.moveaxis(np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]), 2, 0)
    counts = np.array([base.holds((xy - at) @ turn).sum() for at, turn in zip(bases, turns, strict=True)])
    np.testing.assert_array_equal(crowded_bases(points, bases, yaw, base), counts >= 3)
    assert 20 < (counts >= 3).sum() < 280


def test_the_inner_circle_touches_the_nearest_side() -> None:
    assert read_footprint("-0.3,-0.2;0.5,-0.2;0.5,0.4;-0.3,0.4").inner_radius_m == pytest.approx(0.2)
    assert read_footprint("0.25").inner_radius_m == 0.25
