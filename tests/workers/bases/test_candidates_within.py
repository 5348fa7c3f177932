"""Candidates with `within`: those of the simplest form of the draw, and distributed as the documents say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

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


Drawn = tuple[int, np.ndarray, SceneCandidates]
HOUSES = [
    table_house(),
    table_house([cupboard(0, 0.05), cupboard(1, 0.05), cupboard(3, 0.02)]),
    table_house([cupboard(1, 0.3), cupboard(2, 0.35), cupboard(3, 0.2)]),
    table_house([cupboard(k, 0.0, 1.0) for k in range(4)]),
]
OBSTACLES = [obstacles_of(house) for house in HOUSES]
PARAMS = CandidateParams(within="in-range", per_scene=2, robots_per_scene=2, grid_cells=13, scaled_base=True)


def draw_target(rng: np.random.Generator) -> tuple[int, np.ndarray]:
    """A house, and a target anywhere on its table."""
    offset = (rng.random(2) - 0.5) * TABLE_SIZE_M
    return int(rng.integers(len(HOUSES))), np.array([*(np.array(MIDDLE) + offset), TABLE_TOP_M + 0.05])


def drawn(rng: np.random.Generator) -> Drawn:
    """A scene as it is drawn: house and target are rejected together where too few robots have room."""
    while True:
        house, target_m = draw_target(rng)
        candidates = draw_candidates(target_m, OBSTACLES[house], PARAMS, rng)
        if candidates is not None:
            return house, target_m, candidates


def by_rejection(rng: np.random.Generator) -> Drawn:
    """The distribution as it is stated: the first robots that fit, each at any position in the set."""
    params = PARAMS.model_copy(update={"per_scene": 1, "robots_per_scene": 1})
    cells, step_m = grid_offsets(params), 2 / 12
    while True:
        house, target_m = draw_target(rng)
        found: list[SceneCandidates] = []
        for _ in range(DRAWS_A_ROBOT * 2):
            shape = ROUNDS * len(cells)
            camera, mount, reach = (
                np.full(shape, rng.uniform(r.low, r.high), np.float32)
                for r in (params.camera_height_m, params.base_height_m, params.arm_reach_m)
            )
            jitter_m = rng.uniform(-step_m / 2, step_m / 2, (shape, 2))
            xy_m = (target_m[:2] + np.tile(cells, (ROUNDS, 1)) + jitter_m).astype(np.float32)
            there = SceneCandidates(xy_m, np.zeros(shape, np.int16), camera, mount, reach, np.zeros(shape))
            near = np.flatnonzero(distances(there, target_m)[1] <= reach)
            there = SceneCandidates(*(column[near] for column in vars(there).values()))
            radius_m = params.radius_of_base_m(there.arm_reach_m)
            heights = (there.base_height_m, there.camera_height_m)
            clearance_m = base_clearance_m(
                there.base_xy_m, *heights, radius_m, OBSTACLES[house], params.mast_radius_m
            )
            there = replace(there, clearance_m=clearance_m)
            inside = np.flatnonzero(clearance_m >= 0)
            if len(inside):
                k = rng.choice(inside)
                found.append(SceneCandidates(*(column[k : k + 1] for column in vars(there).values())))
            if len(found) == 2:
                columns = (np.concatenate([vars(one)[name] for one in found]) for name in vars(found[0]))
                return house, target_m, SceneCandidates(*columns)


def samples(draw: Callable[[np.random.Generator], Drawn], n: int, seed: int) -> dict[str, np.ndarray]:
    """Quantities of n scenes, one row each."""
    rng = np.random.default_rng(seed)
    rows: dict[str, list[float]] = {}
    for _ in range(n):
        house, target_m, candidates = draw(rng)
        base_m = candidates.base_xy_m - target_m[:2]
        row = {
            **{"house": house, "target x": target_m[0], "target y": target_m[1]},
            **{"base x": base_m[0, 0], "base y": base_m[0, 1], "mount": candidates.base_height_m[0]},
            **{"camera": candidates.camera_height_m[0], "reach": candidates.arm_reach_m[0]},
            **{"base x of the second": base_m[1, 0], "reach of the second": candidates.arm_reach_m[1]},
        }
        for name, value in row.items():
            rows.setdefault(name, []).append(float(value))
    return {name: np.array(values) for name, values in rows.items()}


def test_the_distribution_is_the_stated_one() -> None:
    """Ten two-sample tests at a level of 0.1 % each: of a hundred sound draws, one would fail by chance."""
    made, plain = samples(drawn, 250, 1), samples(by_rejection, 250, 2)
    for name in made:
        if name == "house":
            counts = [np.bincount(table[name].astype(int), minlength=len(HOUSES)) for table in (made, plain)]
            kept = np.sum(counts, axis=0) > 0
            p = stats.chi2_contingency(np.array(counts)[:, kept]).pvalue
        else:
            p = stats.ks_2samp(made[name], plain[name]).pvalue
        assert p > 0.001, (name, p)
    # The condition is felt: short arms fit less often.
    assert stats.kstest(made["reach"], stats.uniform(0.3, 0.7).cdf).pvalue < 0.001
