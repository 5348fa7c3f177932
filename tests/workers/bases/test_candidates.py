"""Candidates: the grid, its random subset, places clear or in range as by a simple draw, and the robots."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.specification import CandidateParams
from datagen.workers.bases.candidates import (
    DRAWS_A_ROBOT,
    ROUNDS,
    SceneCandidates,
    distances,
    draw_candidates,
    grid_offsets,
)
from datagen.workers.bases.clearance import Footprint, HouseObstacles, base_clearance_m
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.houses.house import StaticBody
from tests.workers.worlds import ROOM_M, TABLE_SIZE_M, TABLE_TOP_M, box_body, table_house

MIDDLE = (ROOM_M[0] / 2, ROOM_M[1] / 2)
TARGET = np.array([MIDDLE[0] - 0.35, MIDDLE[1] - 0.2, TABLE_TOP_M + 0.05])  # near a corner
OBSTACLES = HouseObstacles(table_house())
SAME_HEIGHTS = {"camera_height_m": {"low": 1.2, "high": 1.2}, "base_height_m": {"low": 0.7, "high": 0.7}}


def draw(seed: int = 0, **params: object) -> SceneCandidates:
    chosen = CandidateParams.model_validate(params)
    found = draw_candidates(TARGET, OBSTACLES, chosen, np.random.default_rng(seed))
    assert found is not None
    return found


def test_the_whole_grid_of_a_metre_each_way_is_taken_in_order_and_without_jitter() -> None:
    offsets = grid_offsets(CandidateParams())
    assert len({tuple(o) for o in offsets.round(9)}) == 625
    np.testing.assert_allclose([offsets.min(0), offsets.max(0)], [[-1, -1], [1, 1]])
    np.testing.assert_allclose(draw(per_scene="grid").base_xy_m, TARGET[:2] + offsets, atol=1e-6)


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


def test_robots_are_shared_out_evenly_and_keep_their_numbers_or_each_candidate_has_its_own() -> None:
    candidates = draw(per_scene=60, robots_per_scene=4)
    assert np.bincount(candidates.robot_index).tolist() == [15] * 4
    for robot in range(4):
        rows = candidates.robot_index == robot
        for column in (candidates.camera_height_m, candidates.base_height_m, candidates.arm_reach_m):
            assert len(set(column[rows].tolist())) == 1
    each_its_own = draw(per_scene=60, robot_per_candidate=True)
    assert len(set(each_its_own.arm_reach_m.tolist())) == 60


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


def test_the_places_of_clear_candidates_are_spread_as_the_clear_cells_are() -> None:
    drawn = np.concatenate(
        [draw(seed, per_scene=40, within="clear", **SAME_HEIGHTS).base_xy_m for seed in range(40)]
    )
    grid = draw(per_scene="grid", **SAME_HEIGHTS)
    clear = grid.base_xy_m[grid.clearance_m >= 0]
    np.testing.assert_allclose(drawn.mean(0), clear.mean(0), atol=0.05)
    np.testing.assert_allclose(drawn.std(0), clear.std(0), atol=0.05)


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


@given(st.integers(0, 2**32), st.sampled_from([None, "clear"]), st.floats(-3.1, 3.1), st.floats(0.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_headings_lie_in_their_interval_and_change_no_position(
    seed: int, within: str | None, low: float, width: float
) -> None:
    limits = {"low": low, "high": min(low + width, 3.14)}
    plain, turned = (draw(seed, per_scene=40, within=within, yaw_rad=yaw) for yaw in (None, limits))
    for name in ("base_xy_m", "camera_height_m", "base_height_m", "arm_reach_m", "clearance_m"):
        np.testing.assert_array_equal(getattr(turned, name), getattr(plain, name), name)
    towards = TARGET[:2] - plain.base_xy_m
    facing = np.arctan2(towards[:, 1], towards[:, 0])
    np.testing.assert_array_equal(plain.base_yaw_rad, facing.astype(np.float32))
    middle = (limits["low"] + limits["high"]) / 2
    off = np.angle(np.exp(1j * (turned.base_yaw_rad - facing - middle)))
    assert np.abs(off).max() <= (limits["high"] - limits["low"]) / 2 + 1e-5
    assert np.abs(turned.base_yaw_rad).max() <= np.float32(np.pi)
    if width > 0.5 and limits["high"] > limits["low"] + 0.5:
        assert off.std() == pytest.approx((limits["high"] - limits["low"]) / np.sqrt(12), rel=0.4)


def cupboard(side: int, gap_m: float, depth_m: float = 0.4) -> StaticBody:
    """A cupboard along one side of the table."""
    along = side % 2
    off = (TABLE_SIZE_M[1 - along] / 2 + gap_m + depth_m / 2) * (1 if side < 2 else -1)
    centre = (MIDDLE[0] + off, MIDDLE[1]) if along else (MIDDLE[0], MIDDLE[1] + off)
    size = (depth_m, 1.2) if along else (1.4, depth_m)
    return box_body(f"cupboard|{side}", "furniture", "Cabinet", (*size, 1.0), (*centre, 0.5))


@dataclass(frozen=True)
class OneSide:
    """A hand that gets to a ring at the left of its base, below a height."""

    farthest_m: float = 0.8

    def holds(self, positions_base_m: np.ndarray) -> np.ndarray:
        x, y, z = positions_base_m.T
        distance_m = np.hypot(x, y)
        return (y >= -0.1) & (distance_m <= self.farthest_m) & (distance_m > 0.3) & (z < 0.15)


def plain_candidates(
    target_m: np.ndarray,
    obstacles: HouseObstacles,
    params: CandidateParams,
    rng: np.random.Generator,
    hand: OneSide | None = None,
) -> SceneCandidates | None:
    """`draw_candidates` in its simplest form: every robot at every position of every round."""
    n, n_robots = params.count, min(params.robots_per_scene, params.count)
    draws = DRAWS_A_ROBOT * n_robots
    camera_m, mount_m, reach_m = (
        rng.uniform(r.low, r.high, draws).astype(np.float32)
        for r in (params.camera_height_m, params.base_height_m, params.arm_reach_m)
    )
    cells = grid_offsets(params)
    orders = np.concatenate([rng.permutation(len(cells)) for _ in range(ROUNDS)])
    half_m = params.grid_half_width_m / (params.grid_cells - 1)
    jitter_m = rng.uniform(-half_m, half_m, (len(orders), 2))
    xy_m = (target_m[:2] + (cells[orders] + jitter_m)).astype(np.float32)
    yaw_rad = np.arctan2(*(target_m[:2] - xy_m)[:, ::-1].T)
    if params.yaw_rad is not None:
        turned = yaw_rad + rng.uniform(params.yaw_rad.low, params.yaw_rad.high, len(orders))
        yaw_rad = (turned + np.pi) % (2 * np.pi) - np.pi
    yaw_rad = yaw_rad.astype(np.float32)
    footprint = None if params.footprint_m is None else Footprint(params.footprint_m)
    free = np.ones(len(xy_m), np.bool_)
    rows = np.empty(n, np.int64)
    robots: list[int] = []
    for k in range(draws):
        camera, mount, reach = (np.full(len(xy_m), v[k]) for v in (camera_m, mount_m, reach_m))
        radius_m = params.radius_of_base_m(reach)
        mast_m = params.mast_radius_m
        clearance_m = base_clearance_m(xy_m, mount, camera, radius_m, obstacles, mast_m, footprint, yaw_rad)
        one = np.zeros(len(xy_m), np.int16)
        there = SceneCandidates(xy_m, yaw_rad, one, camera, mount, reach, clearance_m)
        inside = clearance_m >= 0
        if params.within == "in-range" and hand is not None:
            inside &= hand.holds(seen_from(there, target_m))
        elif params.within == "in-range":
            inside &= distances(there, target_m)[1] <= reach
        own = np.arange(n) % n_robots == len(robots)
        found = np.flatnonzero(inside & free)[: own.sum()]
        if len(found) < own.sum():
            continue
        rows[own], free[found] = found, False
        robots.append(k)
        if len(robots) == n_robots:
            index = (np.arange(n) % n_robots).astype(np.int16)
            robot = np.array(robots)[index]
            heights = (camera_m[robot], mount_m[robot])
            radius_m = params.radius_of_base_m(reach_m[robot])
            clearance_m = base_clearance_m(
                xy_m[rows], heights[1], heights[0], radius_m, obstacles, mast_m, footprint, yaw_rad[rows]
            )
            return SceneCandidates(xy_m[rows], yaw_rad[rows], index, *heights, reach_m[robot], clearance_m)
    return None


def seen_from(bases: SceneCandidates, target_m: np.ndarray) -> np.ndarray:
    """The target (N, 3) in the frames of the mounts."""
    T = [
        yaw_pose(x, y, height, yaw)
        for (x, y), height, yaw in zip(
            bases.base_xy_m.tolist(), bases.base_height_m.tolist(), bases.base_yaw_rad.tolist(), strict=True
        )
    ]
    return (np.linalg.inv(np.stack(T)) @ np.append(target_m, 1.0))[:, :3]


@given(
    st.integers(0, 2**32),
    st.sampled_from(("in-range", "clear")),
    st.booleans(),
    st.integers(1, 40),
    st.integers(1, 4),
    st.data(),
)
@settings(max_examples=20, deadline=None)
def test_candidates_with_within_are_those_of_trying_every_robot_everywhere(
    seed: int, within: str, scaled: bool, n: int, robots: int, data: st.DataObject
) -> None:
    gaps = data.draw(st.lists(st.floats(0.0, 0.6), min_size=4, max_size=4))
    house = table_house([cupboard(k, gap) for k, gap in enumerate(gaps)])
    # Floors may end where nothing stands.
    inset_m = data.draw(st.floats(0.0, 0.8))
    low, high = (inset_m, inset_m), (ROOM_M[0] - inset_m, ROOM_M[1] - inset_m)
    floor = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    (room,) = house.rooms
    obstacles = HouseObstacles(replace(house, rooms=(replace(room, polygon_m=floor),)))
    given = {"per_scene": n, "within": within, "scaled_base": scaled, "robots_per_scene": robots}
    if data.draw(st.booleans()):
        given["footprint_m"] = [[0.3, 0.15], [-0.45, 0.2], [-0.4, -0.2], [0.3, -0.15]]
        low = data.draw(st.floats(-3, 3))
        given["yaw_rad"] = data.draw(st.sampled_from([None, {"low": low, "high": low + 0.1}]))
    params = CandidateParams.model_validate(given)
    target_m = np.array([*MIDDLE, TABLE_TOP_M + 0.05])
    reach = OneSide() if within == "in-range" and data.draw(st.booleans()) else None
    made, plain = (
        draw(target_m, obstacles, params, np.random.default_rng(seed), reach)
        for draw in (draw_candidates, plain_candidates)
    )
    assert (made is None) == (plain is None)
    if made is not None and plain is not None:
        assert (made.clearance_m >= 0).all()
        if reach is not None:
            assert reach.holds(seen_from(made, target_m)).all()
        elif within == "in-range":
            assert (distances(made, target_m)[1] <= made.arm_reach_m).all()
        for name in (
            "base_xy_m",
            "base_yaw_rad",
            "robot_index",
            "camera_height_m",
            "base_height_m",
            "arm_reach_m",
        ):
            np.testing.assert_array_equal(getattr(made, name), getattr(plain, name), name)
        np.testing.assert_array_equal(made.clearance_m, plain.clearance_m)
