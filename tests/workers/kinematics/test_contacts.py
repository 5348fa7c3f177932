"""Distances and contacts of convex parts against coal, and against planes where parts are flat or points."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.contacts import (
    Parts,
    gap_m,
    hit_any,
    hits_still,
    own_scratch,
    parts_of,
    scratch_of,
    smallest_gap_m,
    touching_pairs,
)
from datagen.workers.motion.planning_scene import still_of
from tests.workers.kinematics.trees import random_coordinates, random_pose
from tests.workers.oracles import Hulls, TreeOracle
from tests.workers.robots.robots_under_test import CASES, Case, opened

SEEDS = st.integers(0, 2**32 - 1)
NEAR_ONE = 1e-5  # m; coal's distances are exact to a millionth


def gap(A: F64, T: F64, B: F64, axis: F64, near_m: float = 0.0, far_m: float = np.inf) -> float:
    return gap_m(A, np.ascontiguousarray(T[:3]), B, near_m, far_m, axis, np.empty((11, 3)), np.empty(3))


def points(kind: str, rng: np.random.Generator) -> F64:
    """Corners of a part (V, 3), with points inside of it; `grid` gives contacts of faces and edges."""
    many = rng.normal(size=(int(rng.integers(4, 20)), 3)) * rng.uniform(0.02, 0.3)
    match kind:
        case "point":
            return many[:1]
        case "repeated":
            return np.repeat(many[: int(rng.integers(1, 5))], 3, axis=0)
        case "line":
            return np.outer(rng.uniform(-0.2, 0.2, len(many)), many[0] / np.linalg.norm(many[0]))
        case "flat":
            return many * (1, 1, 0)
        case "grid":
            return rng.integers(-2, 3, (len(many), 3)) * 0.1
        case "box":
            return ((np.arange(8)[:, None] >> np.arange(3)) & 1) * rng.integers(1, 4, 3) * 0.1
    return many


KINDS = st.sampled_from(["point", "repeated", "line", "flat", "grid", "box", "hull"])


@settings(max_examples=250)
@given(SEEDS, KINDS, KINDS, st.booleans(), st.sampled_from([0.0, 0.0, 10.0]))
def test_the_gap_is_that_of_the_nearest_points(
    seed: int, one: str, other: str, on_grid: bool, away_m: float
) -> None:
    """No plane shows a wider gap; one shows this gap, and a pair of points is as near as this."""
    rng = np.random.default_rng(seed)
    A, B = points(one, rng), points(other, rng) + away_m
    T = translation(*rng.integers(-4, 5, 3) * 0.1) if on_grid else random_pose(rng)
    T[:3, 3] += away_m
    axis = rng.normal(size=3) * rng.integers(0, 2)
    found_m = gap(A, T, B, axis)
    between = ((A @ T[:3, :3].T + T[:3, 3])[:, None] - B).reshape(-1, 3)
    nearest_m = np.zeros(3)
    assert found_m == 0.0 or found_m > 1e-9  # parts that touch have no gap at all
    if found_m > 0.0:
        nearest_m = found_m * axis / np.linalg.norm(axis)
        assert (between @ nearest_m).min() >= found_m * (found_m - 1e-7)
    # The nearest points differ by a mean of differences of corners.
    n = len(between)
    rows = np.vstack([np.append(between.T, -np.eye(3), axis=1), np.append(np.ones(n), np.zeros(3))])
    rows = np.hstack([rows, -np.vstack([-np.eye(3), np.zeros(3)])])
    found = linprog(np.append(np.zeros(n), np.ones(6)), A_eq=rows, b_eq=np.append(nearest_m, 1.0))
    assert found.fun < 1e-6


@settings(max_examples=150)
@given(SEEDS, st.sampled_from(["apart", "touching", "overlapping", "inside"]))
def test_gaps_of_hulls_are_coals(seed: int, relation: str) -> None:
    rng = np.random.default_rng(seed)
    A, B, T = (points("hull", rng), points("hull", rng), random_pose(rng))
    moved = Hulls([A]), T, Hulls([B]), np.eye(4)
    if relation in ("overlapping", "inside"):
        T[:3, 3] = B.mean(axis=0) - T[:3, :3] @ A.mean(axis=0) + rng.normal(size=3) * 0.02
        A = A * 0.01 if relation == "inside" else A
        moved = Hulls([A]), T, Hulls([B]), np.eye(4)
    elif relation == "touching":
        axis = np.zeros(3)
        gap(A, T, B, axis)
        if axis.any():  # they are moved together along the line between the nearest points
            T[:3, 3] -= axis * (1 + 1e-9)
            assert gap(A, T, B, np.zeros(3)) < 1e-7
            return
    wanted_m = max(moved[0].gaps_m(*moved[1:])[0, 0], 0.0)
    for axis in (np.zeros(3), rng.normal(size=3)):
        assert gap(A, T, B, axis) == pytest.approx(wanted_m, abs=NEAR_ONE)


@settings(max_examples=150)
@given(SEEDS, KINDS, KINDS, st.floats(0.0, 0.3), st.floats(0.0, 0.3))
def test_a_gap_that_stops_early_is_a_bound(seed: int, one: str, other: str, a_m: float, b_m: float) -> None:
    rng = np.random.default_rng(seed)
    A, T, B = points(one, rng), random_pose(rng), points(other, rng)
    near_m, far_m = sorted((a_m, b_m))
    exact_m = gap(A, T, B, np.zeros(3))
    found_m = gap(A, T, B, rng.normal(size=3) * rng.integers(0, 2), near_m, far_m)
    if found_m <= near_m:
        assert exact_m <= found_m + 1e-9
    elif found_m > far_m:
        assert exact_m >= found_m - 1e-9
    else:
        assert found_m == pytest.approx(exact_m, abs=1e-9)


def some_parts(rng: np.random.Generator, owners: int, shapes: int = 1) -> tuple[Parts, list[list[F64]]]:
    """Parts of some owners in some shapes, as the hand has them: shape s is the first one, grown."""
    count = [int(rng.integers(0 if k else 1, 3)) for k in range(owners)]
    bodies = [[points("hull", rng) * 0.4 for _ in range(n)] for n in count]
    sizes = [1 + 0.3 * s for s in range(shapes)]
    every = [parts_of([[part * s for part in b] for b in bodies], rng.integers(0, 4, owners)) for s in sizes]
    stacked = {
        name: np.concatenate([getattr(p, name) for p in every]) for name in ("points_m", "center_m", "half_m")
    }
    return every[0]._replace(**stacked), [[part * s for b in bodies for part in b] for s in sizes]


@settings(max_examples=60)
@given(SEEDS)
def test_contacts_with_still_parts_are_those_of_all_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts, bodies = some_parts(rng, 3, shapes=2)
    still_m = [p + rng.uniform(-0.4, 0.4, 3) for p in (points("hull", rng) * 0.5 for _ in range(5))]
    kinds = rng.integers(0, 4, 5).tolist()
    still, scratch = in_memory(still_of(still_m, kinds)), scratch_of(len(parts.owner), 5)
    compiled = in_memory(parts)
    for _ in range(8):  # directions of earlier calls are kept, and change no answer
        shape, ignored, margin_m = int(rng.integers(2)), int(rng.integers(4)), rng.choice([0.0, 0.005, 0.05])
        rows = np.flatnonzero(rng.random(5) < 0.7)
        T = np.stack([random_pose(rng)[:3] for _ in range(3)])
        gaps = pair_gaps_m(bodies[shape], T[parts.owner], still_m)[:, rows]
        kind = np.array(kinds)[rows]
        counts = (kind & parts.touches[:, None]) == 0
        nearest_m = np.where(counts & (kind & ignored == 0), gaps, np.inf).min(initial=np.inf)
        if abs(nearest_m - margin_m) > NEAR_ONE:
            hit = hits_still(compiled, shape, T, still, rows, ignored, margin_m, scratch)
            assert hit == (nearest_m < margin_m)
        nearest_m, far_m = max(np.where(counts, gaps, np.inf).min(initial=np.inf), 0.0), rng.uniform(0.0, 0.4)
        found, bound = (
            smallest_gap_m(compiled, shape, T, still, rows, first, far_m, scratch) for first in (False, True)
        )
        assert found == pytest.approx(min(nearest_m, far_m), abs=NEAR_ONE)
        some = np.append(np.maximum(gaps[counts], 0.0), far_m)
        assert np.abs(some - bound).min() < NEAR_ONE and found - NEAR_ONE <= bound <= far_m
        if parts.touches.any() or nearest_m == 0.0:
            continue
        several = np.stack([T, T + np.array([0.0, 0.0, 0.0, 9.0])])
        if shape == 0 and nearest_m > NEAR_ONE:
            assert not hit_any(compiled, several, still, rows)


def pair_gaps_m(parts: Sequence[F64], T: F64, still: Sequence[F64]) -> F64:
    """Distances (P, F) by coal."""
    other = Hulls(still)
    return np.concatenate([Hulls([p]).gaps_m(T[k], other, np.eye(4)) for k, p in enumerate(parts)])


def test_margins_move_the_border_on_every_side() -> None:
    cube = ((np.arange(8)[:, None] >> np.arange(3)) & 1) * 0.2 - 0.1
    one, wall, scratch = in_memory(parts_of([[cube]])), in_memory(still_of([5 * cube], [0])), scratch_of(1, 1)
    for way in np.vstack([np.eye(3), -np.eye(3)]):
        for apart_m, margin_m in product((-0.003, 0.003, 0.007), (0.0, 0.005)):
            T = np.column_stack([np.eye(3), way * (0.6 + apart_m)])[None].copy()
            hit = hits_still(one, 0, T, wall, np.arange(1), 0, margin_m, scratch)
            assert hit == (apart_m < margin_m)


def test_parts_of_nothing_touch_nothing() -> None:
    cube = ((np.arange(8)[:, None] >> np.arange(3)) & 1) * 0.2
    none, one = (in_memory(still_of(p, [0] * len(p))) for p in ([], [cube]))
    T = np.ascontiguousarray(np.eye(4)[None, None, :3])
    assert not hit_any(in_memory(parts_of([[cube]])), T, none, np.arange(0))
    assert not hit_any(in_memory(parts_of([()])), T, one, np.arange(1))
    assert not hit_any(in_memory(parts_of([[cube]])), T[:0], one, np.arange(1))
    assert hit_any(in_memory(parts_of([[cube]])), np.concatenate([T + 9, T]), one, np.arange(1))


@pytest.mark.parametrize("case", CASES)
def test_a_robot_touches_itself_where_coal_says_so(case: Case) -> None:
    """Pair by pair in random configurations, of all pairs of links that one joint does not hold together."""
    robot = opened(case)
    own, rng, oracle = robot.self_collision, np.random.default_rng(2), TreeOracle(robot.tree)
    parts, links = own.parts, own.parts.owner
    pairs = np.array([(a, b) for a in range(len(links)) for b in range(a) if links[a] != links[b]], np.int64)
    compiled = in_memory(parts)
    hulls = [Hulls([parts.points_m[a:b]]) for a, b in zip(parts.first, parts.first[1:], strict=False)]
    scratch, touch = own_scratch(compiled), np.empty((1, len(pairs)), np.bool_)
    watched = {(a, b) for a, b in own.part_pairs.tolist()}
    for _ in range(6):
        q = random_coordinates(robot.tree, rng)
        T = oracle.frames(q)
        touching_pairs(compiled, pairs, np.ascontiguousarray(T[None, :, :3]), scratch, touch)
        gaps = np.array([hulls[a].gaps_m(T[links[a]], hulls[b], T[links[b]], 0.0)[0, 0] for a, b in pairs])
        assert (touch[0] == (gaps < 0.0))[np.abs(gaps) > 1e-9].all()
        hit = any((min(pair), max(pair)) in watched for pair in pairs[gaps < 0.0].tolist())
        assert robot.collides_itself(q) == hit
    assert {(int(links[a]), int(links[b])) for a, b in watched} <= set(robot.self_pairs)
