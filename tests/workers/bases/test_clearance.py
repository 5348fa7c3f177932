"""Where a robot's body fits: known distances to the table, the walls and the room's end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.specification import CandidateParams
from datagen.workers.bases.clearance import base_clearance_m, obstacles_of
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
    return float(base_clearance_m(place, *heights, radius_m, obstacles_of(house), PARAMS.mast_radius_m)[0])


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
