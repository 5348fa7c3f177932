"""Where a robot's body fits: known distances to the table, the walls and the room's end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.specification import CandidateParams
from datagen.workers.bases.clearance import (
    FAR_M,
    Footprint,
    HouseObstacles,
    Obstacles,
    base_clearance_m,
    distances_from_obstacles,
)
from datagen.workers.geometry.planar import convex_hull, polygons_at, signed_distances_to_convex
from datagen.workers.houses.house import House
from tests.workers.worlds import ROOM_M, TABLE_SIZE_M, box_body, table_house

PARAMS = CandidateParams()
HOUSE = table_house()
TABLE_WEST = ROOM_M[0] / 2 - TABLE_SIZE_M[0] / 2
MIDDLE_Y = ROOM_M[1] / 2


def clearance(
    x: float, y: float, base_height_m: float = 0.8, camera_height_m: float = 1.2, house: House = HOUSE
) -> float:
    place, heights = np.float32([[x, y]]), np.float32([[base_height_m], [camera_height_m]])
    radius_m = np.array([PARAMS.base_radius_m])
    return float(base_clearance_m(place, *heights, radius_m, HouseObstacles(house), PARAMS.mast_radius_m)[0])


@pytest.mark.parametrize("gap", [0.0, 0.1, 0.3])
def test_clearance_from_the_table_is_the_gap_less_the_radius(gap: float) -> None:
    x = TABLE_WEST - 0.25 - gap
    assert clearance(x, MIDDLE_Y) == pytest.approx(gap, abs=1e-6)


def test_a_low_base_may_stand_under_the_table_but_its_mast_may_not() -> None:
    # Between the legs, well under the top: only the mast to the camera is in the way.
    assert clearance(ROOM_M[0] / 2, MIDDLE_Y, base_height_m=0.5, camera_height_m=1.2) < 0
    assert clearance(ROOM_M[0] / 2, MIDDLE_Y, base_height_m=0.5, camera_height_m=0.6) > 0


def test_walls_and_the_end_of_the_room_are_obstacles() -> None:
    assert clearance(0.25 + 0.2, MIDDLE_Y) == pytest.approx(0.2, abs=1e-6)
    assert clearance(0.1, MIDDLE_Y) == pytest.approx(-0.15, abs=1e-6)
    assert clearance(-0.05, MIDDLE_Y) < 0  # in the wall
    assert clearance(-3.0, MIDDLE_Y) < 0  # outside the house, far from any wall


def test_bodies_above_the_robot_are_no_obstacles() -> None:
    lamp = box_body("lamp", "furniture", "Lamp", (0.3, 0.3, 0.3), (0.7, 1.5, 2.0))
    assert clearance(0.7, 1.5, house=table_house([lamp])) == clearance(0.7, 1.5)
    shelf = box_body("shelf", "furniture", "Shelf", (0.3, 0.3, 0.1), (0.7, 1.5, 1.0))
    assert clearance(0.7, 1.5, house=table_house([shelf])) < 0  # the mast would pass through it


@given(st.floats(0.05, 3.95), st.floats(0.05, 2.95), st.floats(0.5, 1.0))
@settings(max_examples=100, deadline=None)
def test_a_clear_base_touches_no_box(x: float, y: float, base_height: float) -> None:
    value = clearance(x, y, base_height)
    nearest = 10.0
    for body in HOUSE.bodies:
        for part in body.convex_parts_m:
            low, high = part.min(0), part.max(0)
            if high[2] > 0.02 and low[2] < base_height:
                dx, dy = max(low[0] - x, 0, x - high[0]), max(low[1] - y, 0, y - high[1])
                nearest = min(nearest, float(np.hypot(dx, dy)))
    assert (value >= 0) <= (nearest >= PARAMS.base_radius_m - 1e-5)
    if value >= 0:
        assert value <= nearest - PARAMS.base_radius_m + 1e-5


RIDGEBACK = ((0.48, 0.395), (-0.48, 0.395), (-0.48, -0.395), (0.48, -0.395))
ROBOTS = 40


def of_outlines(
    footprint: Footprint | None,
    xy: np.ndarray,
    yaw: np.ndarray,
    obstacles: Obstacles,
    radius_m: float = 0.25,
    camera_m: float = 1.2,
    only_signs: bool = False,
) -> np.ndarray:
    heights = np.full((2, len(xy)), [[0.7], [camera_m]], np.float32)
    at = xy.astype(np.float32).astype(np.float64)
    around = distances_from_obstacles(at, obstacles, footprint, yaw, 0.7, only_signs)
    return around.clearance_m(*heights, np.full(len(xy), radius_m), 0.05)


def obstacles_of(house: House) -> Obstacles:
    return HouseObstacles(house).near(np.zeros((1, 2)), np.inf, np.inf)


def poses(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xy = rng.uniform((-0.2, -0.2), np.array(ROOM_M) + 0.2, (ROBOTS, 2)).astype(np.float32)
    return xy, rng.uniform(-np.pi, np.pi, ROBOTS).astype(np.float32)


@given(st.integers(0, 2**32), st.integers(1, ROBOTS), st.sampled_from([None, Footprint(RIDGEBACK)]))
@settings(max_examples=30, deadline=None)
def test_footprints_on_demand_give_the_clearance_of_all(seed: int, n: int, outline: Footprint | None) -> None:
    (xy, yaw), lamp = poses(seed), box_body("lamp", "furniture", "Lamp", (0.3, 0.3, 0.3), (0.7, 1.5, 0.9))
    house = table_house([lamp])
    on_demand = HouseObstacles(house)
    for rows in (slice(n), slice(None)):
        heights = np.full((2, len(xy[rows])), [[0.7], [1.2]], np.float32)
        radii = np.full(len(xy[rows]), 0.25)
        found = base_clearance_m(xy[rows], *heights, radii, on_demand, 0.05, outline, yaw[rows])
        np.testing.assert_array_equal(found, of_outlines(outline, xy[rows], yaw[rows], obstacles_of(house)))


@given(st.integers(0, 2**32), st.floats(0.1, 0.5))
@settings(max_examples=30, deadline=None)
def test_a_round_polygon_has_the_clearance_of_the_circle(seed: int, radius_m: float) -> None:
    (xy, yaw), obstacles = poses(seed), obstacles_of(HOUSE)
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = Footprint(radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    circle = of_outlines(None, xy, yaw, obstacles, radius_m)
    off_m = radius_m * (1 - np.cos(np.pi / 64))
    np.testing.assert_allclose(of_outlines(ring, xy, yaw, obstacles, radius_m), circle, atol=off_m + 1e-6)


@given(st.integers(0, 2**32))
@settings(max_examples=30, deadline=None)
def test_a_base_fits_where_no_point_of_its_outline_or_of_an_obstacle_lies_in_the_other(seed: int) -> None:
    """Against dense samples: the clearance is the distance to the nearest point of a border."""
    (xy, yaw), footprint = poses(seed), Footprint(RIDGEBACK)
    # Without a mast: what reaches above the mount there begins below it.
    found = of_outlines(footprint, xy, yaw, obstacles := obstacles_of(HOUSE), camera_m=0.7)
    low = obstacles.low_m < 0.7
    polygons = [convex_hull(each) for each in obstacles.polygons_m[low]]
    t = np.linspace(0, 1, 60, endpoint=False)[:, None, None]
    for k, outline in enumerate(polygons_at(footprint.polygon_m, xy.astype(float), yaw.astype(float))):
        border = (outline * (1 - t) + np.roll(outline, -1, axis=0) * t).reshape(-1, 2)
        gaps = [signed_distances_to_convex(border, each[None]).min() for each in polygons]
        inside = [signed_distances_to_convex(each, outline[None]).min() for each in polygons]
        nearest = min(*gaps, *inside)
        if found[k] > 0.02:
            assert found[k] == pytest.approx(min(nearest, FAR_M), abs=0.01)
        if nearest < -0.01:
            assert found[k] < 0


@given(st.integers(0, 2**32), st.floats(-np.pi, np.pi))
@settings(max_examples=20, deadline=None)
def test_clearance_turns_with_the_whole_scene(seed: int, turn_rad: float) -> None:
    (xy, yaw), obstacles, footprint = poses(seed), obstacles_of(HOUSE), Footprint(RIDGEBACK)
    (around,) = polygons_at(xy.astype(float), np.zeros((1, 2)), np.array([turn_rad]))
    turned = Obstacles(
        np.stack([polygons_at(p, np.zeros((1, 2)), np.array([turn_rad]))[0] for p in obstacles.polygons_m]),
        obstacles.low_m,
        obstacles.high_m,
        tuple(polygons_at(p, np.zeros((1, 2)), np.array([turn_rad]))[0] for p in obstacles.floors_m),
    )
    before = of_outlines(footprint, xy, yaw, obstacles)
    after = of_outlines(footprint, around, (yaw + turn_rad).astype(np.float32), turned)
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_a_long_base_fits_along_a_gap_and_not_across_it() -> None:
    walls = np.array([[[-2, y], [2, y], [2, y + 0.1], [-2, y + 0.1]] for y in (-0.55, 0.45)])
    floor = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    corridor = Obstacles(walls, np.zeros(2), np.ones(2), (floor,))
    long = Footprint(((0.5, 0.3), (-0.6, 0.3), (-0.6, -0.3), (0.5, -0.3)))
    headings = np.array([0.0, np.pi / 2, -np.pi / 2, np.pi], np.float32)
    found = of_outlines(long, np.zeros((4, 2)), headings, corridor)
    np.testing.assert_allclose(found, [0.15, -0.15, -0.15, 0.15], atol=1e-6)


def test_a_footprint_holds_smaller_bases() -> None:
    footprint = Footprint(RIDGEBACK)
    assert footprint.inner_m == pytest.approx(0.395) and footprint.outer_m == pytest.approx(0.6217, abs=1e-4)
    assert footprint.holds(RIDGEBACK, 0.6217, 0.001) and footprint.holds(None, 0.395, 0.001)
    assert not footprint.holds(((0.5, 0.0), (-0.3, 0.2), (-0.3, -0.2)), 0.5, 0.001)
    assert not footprint.holds(None, 0.41, 0.001)


@given(st.integers(0, 2**32), st.sampled_from([RIDGEBACK, ((0.3, 0.1), (-0.5, 0.2), (-0.5, -0.2))]))
@settings(max_examples=30, deadline=None)
def test_signs_tell_the_same_bases_free(seed: int, corners: tuple[tuple[float, float], ...]) -> None:
    (xy, yaw), house = poses(seed), obstacles_of(HOUSE)
    measured, told = (of_outlines(Footprint(corners), xy, yaw, house, only_signs=s) for s in (False, True))
    np.testing.assert_array_equal(told >= 0, measured >= 0)
    assert (told <= measured + 1e-6).all()
