"""Candidates: the grid, its random subset, and the robots dealt out over them."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.specification import CandidateParams
from workers.bases.candidates import distances, draw_candidates, grid_offsets

TARGET = np.array([3.0, -2.0, 0.8])


def draw(seed: int = 0, **params: object):  # type: ignore[no-untyped-def]
    return draw_candidates(TARGET, CandidateParams(**params), np.random.default_rng(seed))  # type: ignore[arg-type]


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
