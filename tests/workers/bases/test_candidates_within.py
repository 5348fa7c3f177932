"""Candidates with `within`: those of the simplest form of the draw, and distributed as the documents say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
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
from datagen.workers.bases.clearance import Obstacles, base_clearance_m, obstacles_of
from datagen.workers.houses.house import StaticBody
from tests.workers.worlds import ROOM_M, TABLE_SIZE_M, TABLE_TOP_M, box_body, table_house

MIDDLE = (ROOM_M[0] / 2, ROOM_M[1] / 2)
WITHIN = st.sampled_from(("in-range", "clear"))


def cupboard(side: int, gap_m: float, depth_m: float = 0.4) -> StaticBody:
    """A cupboard along one side of the table."""
    along = side % 2
    off = (TABLE_SIZE_M[1 - along] / 2 + gap_m + depth_m / 2) * (1 if side < 2 else -1)
    x, y = MIDDLE
    centre = (x + off, y) if along else (x, y + off)
    size = (depth_m, 1.2) if along else (1.4, depth_m)
    return box_body(f"cupboard|{side}", "furniture", "Cabinet", (*size, 1.0), (*centre, 0.5))


def plain_candidates(
    target_m: np.ndarray, obstacles: Obstacles, params: CandidateParams, rng: np.random.Generator
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
    free = np.ones(len(xy_m), np.bool_)
    rows = np.empty(n, np.int64)
    robots: list[int] = []
    for k in range(draws):
        camera, mount, reach = (np.full(len(xy_m), v[k]) for v in (camera_m, mount_m, reach_m))
        radius_m = params.radius_of_base_m(reach)
        clearance_m = base_clearance_m(xy_m, mount, camera, radius_m, obstacles, params.mast_radius_m)
        there = SceneCandidates(xy_m, np.zeros(len(xy_m), np.int16), camera, mount, reach, clearance_m)
        inside = clearance_m >= 0
        if params.within == "in-range":
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
                xy_m[rows], heights[1], heights[0], radius_m, obstacles, params.mast_radius_m
            )
            return SceneCandidates(xy_m[rows], index, *heights, reach_m[robot], clearance_m)
    return None


@given(st.integers(0, 2**32), WITHIN, st.booleans(), st.integers(1, 40), st.integers(1, 4), st.data())
@settings(max_examples=15, deadline=None)
def test_candidates_are_those_of_trying_every_robot_everywhere(
    seed: int, within: str, scaled: bool, n: int, robots: int, data: st.DataObject
) -> None:
    gaps = data.draw(st.lists(st.floats(0.0, 0.6), min_size=4, max_size=4))
    obstacles = obstacles_of(table_house([cupboard(k, gap) for k, gap in enumerate(gaps)]))
    # Floors may end where nothing stands.
    inset_m = data.draw(st.floats(0.0, 0.8))
    low, high = (inset_m, inset_m), (ROOM_M[0] - inset_m, ROOM_M[1] - inset_m)
    floor = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    obstacles = replace(obstacles, floors_m=(floor,))
    params = CandidateParams.model_validate(
        {"per_scene": n, "within": within, "scaled_base": scaled, "robots_per_scene": robots}
    )
    target_m = np.array([*MIDDLE, TABLE_TOP_M + 0.05])
    made, plain = (
        draw(target_m, obstacles, params, np.random.default_rng(seed))
        for draw in (draw_candidates, plain_candidates)
    )
    assert (made is None) == (plain is None)
    if made is not None and plain is not None:
        for name in ("base_xy_m", "robot_index", "camera_height_m", "base_height_m", "arm_reach_m"):
            np.testing.assert_array_equal(getattr(made, name), getattr(plain, name), name)
        np.testing.assert_array_equal(made.clearance_m, plain.clearance_m)
