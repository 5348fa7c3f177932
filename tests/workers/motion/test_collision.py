"""Contacts of many poses at once, against separating axes and by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import pose, translation
from datagen.workers.motion.collision import (
    Hulls,
    hits,
    hulls_of,
    joined,
    object_hulls,
    place,
    place_object,
    smallest_gap_m,
)
from tests.workers.worlds import ball_model, box_vertices

CUBE = box_vertices((0.2, 0.2, 0.2))


def at(*positions: tuple[float, float, float]) -> F64:
    """Poses (M, 1, 4, 4) of one owner."""
    return np.stack([translation(*p)[None] for p in positions])


def test_touching_inside_and_apart() -> None:
    cube, room = hulls_of([[CUBE]]), place([box_vertices((1, 1, 1))])
    poses = at((0, 0, 0), (0.59, 0, 0), (0.61, 0, 0), (0.59, 0.59, 0.59), (0.61, 0.61, 0), (0, 0, -0.65))
    np.testing.assert_array_equal(hits(cube, poses, room), [True, True, False, True, False, False])


def test_margins_move_the_border_both_ways() -> None:
    cube, wall = hulls_of([[CUBE]]), place([box_vertices((1, 1, 1))])
    poses = at((0.603, 0, 0), (0.597, 0, 0))
    for margin_m, wanted in ((0.0, [False, True]), (0.005, [True, True]), (-0.005, [False, False])):
        np.testing.assert_array_equal(hits(cube, poses, wall, margin_m), wanted)


def test_allowed_pairs_and_the_first_hit_alone() -> None:
    pair = hulls_of([[CUBE], [CUBE]])
    still = place([box_vertices((0.1, 0.1, 0.1)), box_vertices((0.1, 0.1, 0.1), (1, 0, 0))])
    far, first, second = translation(0, 0, 9), np.eye(4), translation(1, 0, 0)
    poses = np.stack([[far, far], [first, far], [far, second], [far, first]])
    np.testing.assert_array_equal(hits(pair, poses, still), [False, True, True, True])
    allowed = np.array([[True, False], [False, False]])
    np.testing.assert_array_equal(hits(pair, poses, still, 0.0, allowed), [False, False, True, True])
    np.testing.assert_array_equal(
        hits(pair, poses, still, 0.0, allowed, first_only=True), [False, False, True, False]
    )


def test_nothing_touches_nothing() -> None:
    cube, none = hulls_of([[CUBE]]), place([])
    assert not hits(cube, at((0, 0, 0)), none).any()
    assert len(hits(cube, np.zeros((0, 1, 4, 4)), place([CUBE]))) == 0
    assert not hits(hulls_of([]), at((0, 0, 0)), place([CUBE])).any()
    assert smallest_gap_m(cube, at((0, 0, 0)), none, 0.5, np.zeros((1, 0), bool)) == 0.5


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_boxes_agree_with_separating_axes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.02, 0.5, (2, 2, 3))
    moving = hulls_of([[box_vertices(tuple(s))] for s in sizes[0]])
    poses = np.stack([[random_pose(rng) for _ in range(2)] for _ in range(12)])
    still_at = [random_pose(rng) for _ in range(2)]
    still = place(
        [box_vertices(tuple(s)) @ T[:3, :3].T + T[:3, 3] for s, T in zip(sizes[1], still_at, strict=True)]
    )
    found = hits(moving, poses, still)
    for k, owners in enumerate(poses):
        gaps = [
            separation_m(sizes[0, i], owners[i], sizes[1, j], still_at[j])
            for i, j in product(range(2), repeat=2)
        ]
        if min(abs(g) for g in gaps) > 1e-5:
            assert found[k] == (min(gaps) < 0)
    # Poses asked one by one, and those of a scene in two pieces, give the same.
    assert [bool(hits(moving, poses[k : k + 1], still)[0]) for k in range(12)] == found.tolist()
    pieces = joined([still.rows(np.array([1])), still.rows(np.array([0]))])
    np.testing.assert_array_equal(hits(moving, poses, pieces), found)


def random_pose(rng: np.random.Generator) -> F64:
    return pose(rng.uniform(-0.3, 0.3, 3), rng.normal(size=4))


def separation_m(size_a: F64, T_a: F64, size_b: F64, T_b: F64) -> float:
    """The largest gap of two boxes along their 15 candidate axes; negative where they overlap."""
    A, B = T_a[:3, :3], T_b[:3, :3]
    axes = [*A.T, *B.T, *(np.cross(a, b) for a, b in product(A.T, B.T))]
    line = T_b[:3, 3] - T_a[:3, 3]
    gaps = []
    for axis in axes:
        length = np.linalg.norm(axis)
        if length > 1e-9:
            n = axis / length
            gaps.append(abs(line @ n) - np.abs(A.T @ n) @ size_a / 2 - np.abs(B.T @ n) @ size_b / 2)
    return max(gaps)


def test_the_smallest_gap_is_that_of_the_nearest_pair() -> None:
    ball = ball_model("ball", 0.1)
    moving = object_hulls(ball)
    assert isinstance(moving, Hulls)
    still = joined(
        [place([box_vertices((0.2, 0.2, 0.2), (1, 0, 0))]), place_object(ball, translation(0, 1, 0))]
    )
    nothing = np.zeros((1, 2), np.bool_)
    poses = at((0, 0, 0), (0.5, 0, 0), (0, 0.4, 0))
    assert abs(smallest_gap_m(moving, poses, still, 5.0, nothing) - 0.3) < 1e-3
    assert abs(smallest_gap_m(moving, poses[:1], still, 5.0, nothing) - 0.8) < 1e-3
    assert smallest_gap_m(moving, poses, still, 0.1, nothing) == 0.1
    assert smallest_gap_m(moving, at((1, 0, 0)), still, 5.0, nothing) == 0.0
    ignored = np.array([[True, False]])
    assert abs(smallest_gap_m(moving, poses, still, 5.0, ignored) - 0.4) < 1e-3
