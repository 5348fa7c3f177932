"""Contact pairs on unions of convex parts, held against plain tests of points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import pose
from datagen.workers.grasps.contacts import (
    CONE_RAD,
    Contacts,
    cone_directions,
    contact_pairs,
    solid_of,
    surface_points,
)
from tests.workers.grasps.shapes import bowl_model
from tests.workers.worlds import ball_model, box_vertices

NEAR_M = 2e-5  # the surface's own tolerance, and a little


def pairs_of(parts_m: list[F32], seed: int, n: int = 400, max_width_m: float = 0.08) -> Contacts:
    rng = np.random.default_rng(seed)
    solid = solid_of(parts_m)
    points_m, normals = surface_points(solid, n, rng)
    return contact_pairs(solid, points_m, cone_directions(normals, rng), max_width_m)


def depth_m(parts_m: list[F32], points_m: F64) -> F64:
    """How far (N,) points lie inside the union of the parts, as the deepest part says; negative outside."""
    planes = [ConvexHull(part).equations for part in parts_m]
    return np.max([-(points_m @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes], axis=0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_both_contacts_lie_on_the_surface_of_the_union(seed: int, n_parts: int) -> None:
    rng = np.random.default_rng(seed)
    parts: list[F32] = []
    for _ in range(n_parts):
        T = pose(rng.uniform(-0.03, 0.03, 3), rng.standard_normal(4))
        corners = box_vertices(tuple(rng.uniform(0.01, 0.05, 3)))
        parts.append((corners @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
    pairs = pairs_of(parts, seed, n=100)
    for end in (pairs.first_m, pairs.second_m):
        np.testing.assert_allclose(depth_m(parts, end), 0.0, atol=NEAR_M)
    # The fingers come from outside on both sides. A crack of half a millimetre counts as closed.
    for end, sign in ((pairs.first_m, -1), (pairs.second_m, 1)):
        for step_m in (1e-4, 3e-4):
            assert (depth_m(parts, end + sign * step_m * pairs.closing) < NEAR_M).all()
    assert (pairs.width_m <= 0.08 + 1e-9).all()
    np.testing.assert_allclose(
        pairs.second_m - pairs.first_m, pairs.width_m[:, None] * pairs.closing, atol=1e-9
    )


@pytest.mark.parametrize("seed", range(3))
def test_forces_lie_in_both_friction_cones(seed: int) -> None:
    radius_m = 0.03
    pairs = pairs_of(list(ball_model("ball", radius_m).convex_parts_m), seed)
    assert len(pairs) > 100
    for end, sign in ((pairs.first_m, -1), (pairs.second_m, 1)):
        outward = end / np.linalg.norm(end, axis=1, keepdims=True)
        angle = np.arccos(np.clip(sign * (outward * pairs.closing).sum(axis=1), -1, 1))
        assert (angle < CONE_RAD + np.radians(11)).all()  # facets lean away from the ball by up to that


def test_parts_that_overlap_are_one_body() -> None:
    """Between the parts of a split bar there is nothing to press on."""
    halves = [box_vertices((0.05, 0.03, 0.02), (x, 0.0, 0.0)) for x in (-0.02, 0.02)]
    whole = pairs_of([box_vertices((0.09, 0.03, 0.02))], 0)
    split = pairs_of(halves, 0)
    for pairs in (whole, split):
        along_x = np.abs(pairs.closing[:, 0]) > 0.95
        assert not along_x.any()  # 9 cm is too wide, and there is no wall in the middle
        assert (np.minimum(np.abs(pairs.width_m - 0.03), np.abs(pairs.width_m - 0.02)) < 0.008).all()


def test_a_bowl_is_pressed_on_its_wall() -> None:
    pairs = pairs_of(list(bowl_model().convex_parts_m), 0)
    at_wall = (pairs.width_m < 0.008) & (np.abs(pairs.closing[:, 2]) < 0.3) & (pairs.first_m[:, 2] > 0)
    assert at_wall.sum() > 50
    # From without to within, and from within to without.
    radius = np.linalg.norm(pairs.first_m[at_wall, :2], axis=1)
    assert (radius > 0.068).any() and (radius < 0.067).any()


def test_nothing_is_found_on_what_is_too_wide() -> None:
    assert len(pairs_of([box_vertices((0.2, 0.2, 0.2))], 0)) == 0
