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
    floor_map = draw_map(goal, EYE, obstacles, NOTHING, floor)
    points = np.concatenate([obstacles, floor])
    return WAYS[ways_to(floor_map, goal, slack_m, RADIUS_M, 0.05, points, EYE)[0]]


NOTHING = np.empty((0, 3), np.float32)
OPEN = strip((0.5, 4.0), (-1.5, 1.5), (0.0, 0.0))
TABLE = [strip((1.5, 1.53), (-1.0, 1.0), (0.6, 0.7)), strip((1.5, 2.2), (-1.0, 1.0), (0.7, 0.7))]


@pytest.mark.parametrize(
    ("obstacles", "floor", "expected"),
    [
        (NOTHING, OPEN, "seen"),
        (NOTHING, OPEN[(OPEN[:, 0] < 1.2) | (OPEN[:, 0] > 2.2)], "unseen"),  # of which a part was not seen
        (np.concatenate(TABLE), OPEN[OPEN[:, 0] < 1.5], "unseen"),  # which is no wall
    ],
    ids=["open floor", "floor with a gap", "a low table"],
)
def test_a_way_over_floor_is_seen_where_the_floor_was(obstacles: F32, floor: F32, expected: str) -> None:
    assert way(obstacles, floor) == expected


@pytest.mark.parametrize(("gap_m", "expected"), [(0.8, "seen"), (0.3, "none"), (0.0, "none")])
def test_a_base_fits_through_wide_gaps_alone(gap_m: float, expected: str) -> None:
    sides = [(-8.0, -gap_m / 2), (gap_m / 2, 8.0)]  # of a fence that the camera sees over
    fence = [strip((1.5, 1.56), side, (0.05, 0.6), 0.03) for side in sides]
    assert way(np.concatenate(fence), OPEN) == expected


def test_a_way_around_what_ends_in_sight_is_over_unseen_floor() -> None:
    short = strip((1.5, 1.56), (-1.6, 1.6), (0.05, 0.6), 0.03)
    backdrop = strip((6.0, 6.0), (-8.0, 8.0), (1.0, 1.6), 0.05)  # seen over it, so that it is no wall
    assert way(np.concatenate([short, backdrop]), OPEN) == "unseen"


def test_behind_a_wall_there_is_no_way_even_where_it_ends_in_sight() -> None:
    wall = strip((1.5, 1.56), (-1.0, 1.0), (0.05, 2.0), 0.03)
    front = OPEN[OPEN[:, 0] < 1.5]
    assert way(wall, front) == "none"
    beside = np.array([[3.0, 4.5]])
    assert way(wall, front, beside) == "unseen"


def test_a_narrow_base_may_go_the_last_bit_straight() -> None:
    pocket = np.concatenate(
        [strip((2.7, 3.6), side, (0.05, 0.6), 0.03) for side in ((-0.8, -0.2), (0.2, 0.8))]
    )
    goal = np.array([[2.75, 0.0]])
    assert way(pocket, OPEN, goal) == "none"
    assert way(pocket, OPEN, goal, slack_m=0.25) == "seen"
