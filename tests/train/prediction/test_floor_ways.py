"""Ways of a base over a map of the floor: through gaps, around obstacles, not behind walls."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.train.inputs import F32, F64
from datagen.train.prediction.floor_ways import WAYS, draw_map, ways_to

EYE = np.array([[0.0, 0.0, 1.2]])
GOAL = np.array([[3.0, 0.0]])
RADIUS_M = 0.25


def strip(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], step: float = 0.02) -> F32:
    """Points (N, 3) that fill a box."""
    axes = [np.arange(low, max(high, low + 1e-6), step) for low, high in (x, y, z)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3).astype(np.float32)


def way(obstacles: F32, floor: F32, goal: F64 = GOAL, slack_m: float = 0.0) -> str:
    """How the base gets to one goal."""
    none = np.empty((0, 3), np.float32)
    floor_map = draw_map(goal, EYE, obstacles, none, floor)
    points = np.concatenate([obstacles, floor])
    return WAYS[ways_to(floor_map, goal, slack_m, RADIUS_M, 0.05, points, EYE)[0]]


OPEN = strip((0.5, 4.0), (-1.5, 1.5), (0.0, 0.0))


def fence(gap_m: float, height_m: float = 0.6) -> F32:
    """Obstacles across the way at x = 1.5, with a gap of a width in the middle; the camera sees over them."""
    sides = [(-8.0, -gap_m / 2), (gap_m / 2, 8.0)]
    return np.concatenate([strip((1.5, 1.56), side, (0.05, height_m), 0.03) for side in sides])


def test_over_floor_in_sight() -> None:
    assert way(np.empty((0, 3), np.float32), OPEN) == "seen"


@pytest.mark.parametrize(("gap_m", "expected"), [(0.8, "seen"), (0.3, "none"), (0.0, "none")])
def test_a_base_fits_through_wide_gaps_alone(gap_m: float, expected: str) -> None:
    assert way(fence(gap_m), OPEN) == expected


def test_a_way_around_what_ends_in_sight_is_over_unseen_floor() -> None:
    short = strip((1.5, 1.56), (-1.6, 1.6), (0.05, 0.6), 0.03)
    backdrop = strip((6.0, 6.0), (-8.0, 8.0), (1.0, 1.6), 0.05)  # seen over it, so that it is no wall
    assert way(np.concatenate([short, backdrop]), OPEN) == "unseen"


def test_floor_that_was_not_seen_makes_a_way_unseen() -> None:
    far = OPEN[OPEN[:, 0] > 2.2]
    between = OPEN[(OPEN[:, 0] < 1.2)]
    assert way(np.empty((0, 3), np.float32), np.concatenate([far, between])) == "unseen"


def test_behind_a_wall_there_is_no_way_even_where_it_ends_in_sight() -> None:
    wall = strip((1.5, 1.56), (-1.0, 1.0), (0.05, 2.0), 0.03)
    front = OPEN[OPEN[:, 0] < 1.5]
    assert way(wall, front) == "none"
    beside = np.array([[3.0, 4.5]])
    assert way(wall, front, beside) == "unseen"


def test_a_low_table_is_no_wall() -> None:
    table = np.concatenate(
        [strip((1.5, 1.53), (-1.0, 1.0), (0.6, 0.7)), strip((1.5, 2.2), (-1.0, 1.0), (0.7, 0.7))]
    )
    assert way(table, OPEN[OPEN[:, 0] < 1.5]) == "unseen"


def test_a_narrow_base_may_go_the_last_bit_straight() -> None:
    pocket = np.concatenate(
        [strip((2.7, 3.6), side, (0.05, 0.6), 0.03) for side in ((-0.8, -0.2), (0.2, 0.8))]
    )
    goal = np.array([[2.75, 0.0]])
    assert way(pocket, OPEN, goal) == "none"
    assert way(pocket, OPEN, goal, slack_m=0.25) == "seen"
