"""Paths through slits, their shortcuts, straight lines, and that nothing but the generator decides them."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.arm_motion import (
    NO_HAND,
    Search,
    follow,
    has_free_home,
    is_blocked,
    is_line_free,
    next_home,
)
from datagen.workers.motion.hand_motion import NOTHING, TARGET
from datagen.workers.motion.path_search import connect, dense, shortened
from tests.workers.motion.gantries import ABOVE, CUBE_M, LIMITS, machine
from tests.workers.worlds import box_vertices

START, GOAL, ONES = np.array([-0.8, 0.0, 0.0]), np.array([0.8, 0.0, 0.0]), np.ones(3)
STEP, DOWN = LIMITS.step, ABOVE[:3].copy()


def slit(top_m: float = 0.7) -> Search:
    """A wall across x = 0 with a slit at y above 0.7."""
    return machine([box_vertices((0.2 - CUBE_M, 4.0, 4.0), (0.0, top_m - 2.0 - CUBE_M / 2, 0.0))])


def inside(q: F64) -> np.ndarray:
    return (np.abs(q[:, 0]) < 0.1 - 1e-6) & (q[:, 1] < 0.7 - 1e-6)


def find(wall: Search, seed: int, iterations: int = 500) -> tuple[F64, int]:
    return connect(wall, NO_HAND, START, GOAL, iterations, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(8))
def test_a_path_goes_through_the_slit(seed: int) -> None:
    wall = slit()
    path, used = find(wall, seed)
    assert len(path) > 2 and 1 <= used <= 500
    np.testing.assert_array_equal(path[[0, -1]], [START, GOAL])
    line = dense(ONES, path, STEP)
    assert not inside(line).any() and (np.abs(path) <= 1.0).all()
    rng = np.random.default_rng(seed)
    short = shortened(wall, NO_HAND, shortened(wall, NO_HAND, line, rng), rng)
    assert not inside(short).any()
    assert np.linalg.norm(np.diff(short, axis=0), axis=1).max() <= STEP + 1e-12
    np.testing.assert_array_equal(short[[0, -1]], path[[0, -1]])
    length, before = (np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in (short, path))
    assert length <= before + 1e-12
    assert length < 3.2  # the shortest through the slit's edge is 2.1


def test_the_generator_alone_decides() -> None:
    first, _ = find(slit(), 3)
    np.random.seed(1)  # noqa: NPY002 - the global state must not matter
    wall = slit()
    find(wall, 4)
    np.testing.assert_array_equal(first, find(wall, 3)[0])
    assert not np.array_equal(first, find(slit(), 5)[0])


def test_a_closed_wall_ends_at_the_cap() -> None:
    for iterations in (0, 50):
        path, used = find(slit(top_m=2.0), 0, iterations)
        assert (len(path), used) == (0, iterations)


def test_straight_lines_end_to_the_bit_and_keep_the_step() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        corners, weight = rng.normal(size=(4, 7)), rng.choice([1.0, 2.0], 7)
        path = dense(weight, corners, STEP)
        assert all((path == c).all(axis=1).any() for c in corners)
        np.testing.assert_array_equal(path[[0, -1]], corners[[0, -1]])
        assert np.linalg.norm(np.diff(path, axis=0) * weight, axis=1).max() <= STEP + 1e-12
    np.testing.assert_array_equal(dense(weight, corners[[0, 0]], STEP), corners[[0, 0]])


@pytest.mark.parametrize("steps", [1, 7, 16, 17, 40])
def test_a_line_is_free_only_where_every_step_is(steps: int) -> None:
    """A speck at any step but the first point is found, also on lines that are looked at coarsely first."""
    a, b = np.array([-0.5, 0.0, 0.0]), np.array([-0.5 + steps * STEP, 0.0, 0.0])
    for k in range(steps + 1):
        speck = box_vertices((0.001,) * 3, tuple(a + (b - a) * k / steps))
        assert is_line_free(machine([speck]), a, b, NO_HAND, NOTHING) == (k == 0), k


def test_arm_and_hand_are_blocked_by_what_is_not_ignored() -> None:
    beside_arm, beside_hand = (box_vertices((0.1,) * 3, (0.063, 0.0, z)) for z in (0.0, 0.1))
    q = np.zeros(3)
    for box, of_arm in ((beside_arm, True), (beside_hand, False)):
        for margin_m, touches in ((0.002, False), (0.004, True)):
            at = machine([box], [int(TARGET)], LIMITS._replace(margin_m=margin_m))
            assert is_blocked(at, q, 0, NOTHING) == touches
            assert is_blocked(at, q, NO_HAND, NOTHING) == (touches and of_arm)
            assert not is_blocked(at, q, 0, TARGET)
    near_hand = machine([box_vertices((0.1,) * 3, (0.067, 0.0, 0.1))])
    assert [is_blocked(near_hand, q, opening, NOTHING) for opening in (0, 1)] == [False, True]


def followed(at: Search, rows: int, back_m: float, rise_m: float, ignored: int = NOTHING) -> bool:
    """Whether the hand, which stands 0.1 above its arm, can leave the middle along a line."""
    out = np.zeros((rows, 3))
    if back_m:
        out[-1] = (0.0, 0.0, -back_m)
    return follow(at, DOWN, back_m, rise_m, ignored, out)


def test_a_line_is_followed_where_the_arm_is_free_and_its_joints_reach() -> None:
    free, out = machine([]), np.zeros((5, 3))
    assert followed(free, 5, 0.08, 0.0) and followed(free, 5, 0.0, 0.08)
    assert follow(free, DOWN, 0.0, 0.08, NOTHING, out)
    np.testing.assert_allclose(out[:, 2], np.linspace(0, 0.08, 5), atol=0.0005)
    assert not followed(free, 5, 0.0, 1.2)  # beyond the limits
    assert not followed(machine([], limits=LIMITS._replace(jump=0.015)), 5, 0.08, 0.0)
    assert followed(machine([], limits=LIMITS._replace(jump=0.025)), 5, 0.08, 0.0)
    fine = LIMITS._replace(step=0.005)
    for k in range(17):  # a speck anywhere on the way of the arm, from the first point to the last
        at = machine([box_vertices((0.04, 0.04, 0.001), (0.0, 0.0, -0.005 * k))], [int(TARGET)], fine)
        for rows in (3, 5):
            assert not followed(at, rows, 0.08, 0.0)
            assert followed(at, rows, 0.08, 0.0, TARGET)
        if k * 0.005 > CUBE_M / 2 + 0.001:
            assert followed(at, 5, 0.0, 0.08)


def test_a_hand_that_leaves_the_line_between_its_points_does_not_follow() -> None:
    """An arm that turns, slides out and turns its hand: between far points it moves on arcs."""
    T = np.eye(4)
    T[:3, :3] = np.eye(3)[[1, 2, 0]]  # the hand looks along y
    axes = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    at = machine([], (), LIMITS._replace(jump=9.0), (), axes, (False, True, False), T)
    goal = np.column_stack([T[:3, :3], [0.2, 0.0, 0.0]])
    for rows, is_straight in ((2, False), (3, False), (9, True)):
        out = np.zeros((rows, 3))
        out[0], out[-1] = (0.0, 0.2, 0.0), (-np.pi / 4, 0.2 * np.sqrt(2), np.pi / 4)
        assert follow(at, goal, 0.2, 0.0, NOTHING, out) == is_straight


def test_homes_that_are_free_come_in_the_order_of_their_distance() -> None:
    homes = [np.array([x, 0.0, 0.0]) for x in (0.5, -0.2, 0.3, -0.3, 0.9)]
    blocked = box_vertices((0.05,) * 3, (0.9, 0.0, 0.1))  # by the hand
    at = machine([blocked], homes=homes)
    assert has_free_home(at)
    order, home = list[int](), -1
    while (home := next_home(at, np.zeros(3), home)) >= 0:
        order.append(home)
    assert order == [1, 2, 3, 0]
    nowhere = machine([box_vertices((3.0, 1.0, 1.0))], homes=homes)
    assert not has_free_home(nowhere) and next_home(nowhere, np.zeros(3), -1) == -1
