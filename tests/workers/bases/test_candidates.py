"""Candidates: the grid, its random subset, places that are clear or in range, and the robots on them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.specification import CandidateParams
from datagen.workers.bases.candidates import SceneCandidates, distances, draw_candidates, grid_offsets
from datagen.workers.bases.clearance import base_clearance_m, obstacles_of
from tests.workers.worlds import ROOM_M, TABLE_TOP_M, table_house

TARGET = np.array([ROOM_M[0] / 2 - 0.35, ROOM_M[1] / 2 - 0.2, TABLE_TOP_M + 0.05])  # near a corner
OBSTACLES = obstacles_of(table_house())
SAME_HEIGHTS = {"camera_height_m": {"low": 1.2, "high": 1.2}, "base_height_m": {"low": 0.7, "high": 0.7}}
FAR_ARMS = {"low": 0.8, "high": 1.0}


def draw(seed: int = 0, **params: object) -> SceneCandidates:
    chosen = CandidateParams.model_validate(params)
    found = draw_candidates(TARGET, OBSTACLES, chosen, np.random.default_rng(seed))
    assert found is not None
    return found


def cells_of(candidates: SceneCandidates) -> np.ndarray:
    """The grid cell (N, 2) that each candidate stands in."""
    return np.rint((candidates.base_xy_m.astype(np.float64) - TARGET[:2]) * 12)


def test_the_grid_spans_a_metre_each_way_and_holds_every_cell_once() -> None:
    offsets = grid_offsets(CandidateParams())
    assert len({tuple(o) for o in offsets.round(9)}) == 625
    np.testing.assert_allclose([offsets.min(0), offsets.max(0)], [[-1, -1], [1, 1]])


def test_the_whole_grid_is_taken_in_order_and_without_jitter() -> None:
    candidates = draw(per_scene="grid")
    np.testing.assert_allclose(candidates.base_xy_m, TARGET[:2] + grid_offsets(CandidateParams()), atol=1e-6)


@given(st.integers(0, 2**32), st.integers(1, 625))
@settings(max_examples=50)
def test_a_subset_keeps_within_half_a_cell_of_different_cells(seed: int, n: int) -> None:
    candidates = draw(seed, per_scene=n)
    cell = 2 / 24
    place = (candidates.base_xy_m - TARGET[:2].astype(np.float32)) / cell
    cells = np.rint(place.astype(np.float64))
    assert np.abs(place - cells).max() <= 0.5 + 1e-4
    unjittered = draw(seed, per_scene=n, jitter=False).base_xy_m.round(4)
    assert len({tuple(row) for row in unjittered}) == n


def test_robots_are_shared_out_evenly_and_keep_their_numbers() -> None:
    candidates = draw(per_scene=60, robots_per_scene=4)
    assert np.bincount(candidates.robot_index).tolist() == [15] * 4
    for robot in range(4):
        rows = candidates.robot_index == robot
        for column in (candidates.camera_height_m, candidates.base_height_m, candidates.arm_reach_m):
            assert len(set(column[rows].tolist())) == 1


def test_one_robot_a_candidate_is_the_papers_draw() -> None:
    candidates = draw(per_scene=60, robot_per_candidate=True)
    assert len(set(candidates.arm_reach_m.tolist())) == 60


@given(st.integers(0, 2**32))
@settings(max_examples=30)
def test_robot_numbers_stay_in_their_ranges_and_seeds_repeat(seed: int) -> None:
    a, b = draw(seed), draw(seed)
    for column, low, high in (
        (a.camera_height_m, 0.8, 1.5),
        (a.base_height_m, 0.5, 1.0),
        (a.arm_reach_m, 0.3, 1.0),
    ):
        assert (column >= np.float32(low)).all() and (column <= np.float32(high)).all()
    np.testing.assert_array_equal(a.base_xy_m, b.base_xy_m)


def test_distances_are_planar_and_from_the_mount() -> None:
    candidates = draw(per_scene=5)
    planar, mount = distances(candidates, TARGET)
    rel = candidates.base_xy_m - TARGET[:2]
    np.testing.assert_allclose(planar, np.hypot(rel[:, 0], rel[:, 1]), rtol=1e-6)
    np.testing.assert_allclose(mount**2, planar**2 + (TARGET[2] - candidates.base_height_m) ** 2, rtol=1e-5)


def test_clearance_is_that_of_the_robot_where_it_stands() -> None:
    for candidates in (draw(per_scene="grid"), draw(per_scene=60), draw(per_scene=60, within="clear")):
        alone = [
            base_clearance_m(
                candidates.base_xy_m[k : k + 1],
                candidates.base_height_m[k : k + 1],
                candidates.camera_height_m[k : k + 1],
                np.array([0.25]),
                OBSTACLES,
                0.05,
            )[0]
            for k in range(0, len(candidates), 7)
        ]
        np.testing.assert_array_equal(candidates.clearance_m[::7], alone)


@given(st.integers(0, 2**32), st.integers(1, 60), st.integers(1, 5))
@settings(max_examples=30, deadline=None)
def test_clear_candidates_are_clear_and_stand_in_different_cells(seed: int, n: int, robots: int) -> None:
    candidates = draw(seed, per_scene=n, within="clear", robots_per_scene=robots)
    assert len(candidates) == n and (candidates.clearance_m >= 0).all()
    assert (candidates.robot_index == np.arange(n) % robots).all()
    assert len({tuple(cell) for cell in cells_of(candidates)}) == n
    again = draw(seed, per_scene=n, within="clear", robots_per_scene=robots)
    np.testing.assert_array_equal(candidates.base_xy_m, again.base_xy_m)


@given(st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_candidates_in_range_are_clear_and_within_reach_of_their_robot(seed: int) -> None:
    candidates = draw(seed, per_scene=24, within="in-range", arm_reach_m=FAR_ARMS)
    assert (candidates.clearance_m >= 0).all()
    assert (distances(candidates, TARGET)[1] <= candidates.arm_reach_m).all()


def test_the_places_of_clear_candidates_are_spread_as_the_clear_cells_are() -> None:
    drawn = np.concatenate(
        [draw(seed, per_scene=40, within="clear", **SAME_HEIGHTS).base_xy_m for seed in range(40)]
    )
    grid = draw(per_scene="grid", **SAME_HEIGHTS)
    clear = grid.base_xy_m[grid.clearance_m >= 0]
    np.testing.assert_allclose(drawn.mean(0), clear.mean(0), atol=0.05)
    np.testing.assert_allclose(drawn.std(0), clear.std(0), atol=0.05)


def test_cells_repeat_only_where_too_few_are_clear() -> None:
    # A base almost as wide as the way between table and wall: few cells are clear.
    wide = {"base_radius_m": 0.43, "jitter": False, **SAME_HEIGHTS}
    grid = draw(per_scene="grid", **wide)
    clear = int((grid.clearance_m >= 0).sum())
    assert 10 < clear < 300
    few = draw(per_scene=clear, within="clear", robots_per_scene=1, **wide)
    assert len({tuple(cell) for cell in cells_of(few)}) == clear
    many = draw(per_scene=2 * clear, within="clear", robots_per_scene=1, **wide)
    cells = [tuple(cell) for cell in cells_of(many)]
    assert {cells.count(cell) for cell in cells} == {2}


@pytest.mark.parametrize(
    "params",
    [
        {"within": "clear", "base_radius_m": 2.0},
        {"within": "in-range", "arm_reach_m": {"low": 0.05, "high": 0.05}},
    ],
)
def test_a_scene_without_room_has_no_candidates(params: dict[str, object]) -> None:
    chosen = CandidateParams.model_validate(params)
    assert draw_candidates(TARGET, OBSTACLES, chosen, np.random.default_rng(0)) is None


@given(st.integers(0, 2**32), st.floats(0.3, 0.9), st.floats(0.01, 0.1))
@settings(max_examples=50)
def test_reaches_are_whole_steps_within_their_range(seed: int, low: float, width: float) -> None:
    limits = {"low": low, "high": low + width}
    drawn = draw(seed, per_scene=20, robot_per_candidate=True, arm_reach_m=limits)
    stepped = draw(seed, per_scene=20, robot_per_candidate=True, arm_reach_m=limits, arm_reach_step_m=0.01)
    np.testing.assert_array_equal(stepped.base_xy_m, drawn.base_xy_m)
    reach_m = stepped.arm_reach_m.astype(np.float64)
    assert np.abs(reach_m - drawn.arm_reach_m).max() <= 0.005 + 1e-6
    assert (reach_m >= low - 1e-6).all() and (reach_m <= low + width + 1e-6).all()
    inside = (reach_m > low + 1e-6) & (reach_m < low + width - 1e-6)
    np.testing.assert_allclose(reach_m[inside] * 100, np.round(reach_m[inside] * 100), atol=1e-4)
