"""Where the hand is: frames, clearance of object and table, and whether it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import pose
from datagen.workers.grasps.contacts import Contacts
from datagen.workers.grasps.floating_hand import PULLS, HandTest, held_trials
from datagen.workers.grasps.search import APPROACH_M, HandClearance, hand_poses, lowest_m, varied
from tests.workers.grasps.shapes import TIP_M, bowl_model, box_gripper
from tests.workers.worlds import box_model, box_vertices

GRIPPER = box_gripper()
FROM_ABOVE = np.diag([1.0, -1.0, -1.0, 1.0])


def poses_around(seed: int, n: int, spread_m: float = 0.08) -> F64:
    rng = np.random.default_rng(seed)
    return np.array([pose(rng.uniform(-spread_m, spread_m, 3), rng.standard_normal(4)) for _ in range(n)])


def test_frames_are_right_handed_and_put_the_contacts_on_the_pads() -> None:
    rng = np.random.default_rng(0)
    first = rng.uniform(-0.02, 0.02, (50, 3))
    closing = rng.standard_normal((50, 3))
    closing /= np.linalg.norm(closing, axis=1, keepdims=True)
    pairs = Contacts(first, first + 0.03 * closing, closing)
    T, width_m = hand_poses(pairs, 2 * TIP_M, rng)
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1)
    np.testing.assert_allclose(width_m, 0.03)
    # In every TCP frame some pair lies at (0, +-width / 2, within the pad).
    for R, p in zip(T[::97, :3, :3], T[::97, :3, 3], strict=True):
        ends = np.stack([(pairs.first_m - p) @ R, (pairs.second_m - p) @ R])
        off = np.abs(ends[:, :, 0]).max(axis=0) + np.abs(np.abs(ends[:, :, 1]) - 0.015).max(axis=0)
        row = int(off.argmin())
        assert off[row] < 1e-9 and (np.abs(ends[:, row, 2]) <= TIP_M).all()


def test_varied_poses_spread_before_they_crowd() -> None:
    near, far = poses_around(2, 1), poses_around(3, 5)
    crowd = np.repeat(near, 50, axis=0)
    chosen = varied(np.concatenate([crowd, far]), 6)
    assert set(chosen[1:].tolist()) == set(range(50, 55)) and chosen[0] == 0
    assert len(set(varied(poses_around(4, 20), 50).tolist())) == 20
    assert len(varied(np.zeros((0, 4, 4)), 5)) == 0


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_free_hand_holds_no_point_of_the_object_on_its_way(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = bowl_model().convex_parts_m
    T = poses_around(seed, 40)
    opening_m = rng.uniform(0.01, 0.08, 40)
    free = HandClearance(parts, GRIPPER).free(T, opening_m)
    weights = [rng.dirichlet(np.full(len(part), 0.2), 40) for part in parts]
    points = np.concatenate([w @ part for w, part in zip(weights, parts, strict=True)])
    for row in range(40):
        back = np.array([0.0, 0.0, APPROACH_M])
        inside = np.zeros(len(points), bool)
        for way in (0.0, 0.3, 1.0):
            at = (points - T[row, :3, 3]) @ T[row, :3, :3] + way * back
            inside |= inside_any(GRIPPER.parts_at(float(opening_m[row])), at)
        if free[row]:
            assert not inside.any()
    assert HandClearance(parts, GRIPPER).free(T[:0], opening_m[:0]).shape == (0,)


def inside_any(parts: tuple[F32, ...], points: F64) -> np.ndarray:
    planes = [ConvexHull(part).equations for part in parts]
    return np.any([(points @ p[:, :3].T + p[:, 3] < -1e-5).all(axis=1) for p in planes], axis=0)


def test_a_hand_that_overlaps_is_seen_even_where_it_holds_the_whole_object() -> None:
    dice = box_vertices((0.01, 0.01, 0.01))
    inside_palm = FROM_ABOVE.copy()
    inside_palm[2, 3] = -0.06
    clearance = HandClearance([dice], GRIPPER)
    T = np.stack([FROM_ABOVE, inside_palm])
    assert clearance.free(T, np.array([0.03, 0.03])).tolist() == [True, False]
    assert clearance.free(T[:1], np.array([0.005])).tolist() == [False]


def test_the_lowest_point_is_that_of_the_parts() -> None:
    T, opening_m = poses_around(5, 30), np.random.default_rng(5).uniform(0, 0.08, 30)
    low = lowest_m(GRIPPER, T, opening_m)
    for row in range(30):
        corners = np.concatenate(GRIPPER.parts_at(float(opening_m[row]))).astype(np.float64)
        way = np.concatenate([corners, corners - [0, 0, APPROACH_M]])
        assert low[row] == pytest.approx((way @ T[row, 2, :3] + T[row, 2, 3]).min(), abs=1e-6)


def hold(mass_kg: float = 0.3, **changes: float) -> np.ndarray:
    box = box_model("box", (0.06, 0.04, 0.08))
    T = np.tile(FROM_ABOVE, (2, 1, 1))
    test, rng = replace(HandTest(), **changes), np.random.default_rng(0)
    return held_trials(box.convex_parts_m, mass_kg, GRIPPER, T, np.array([0.06, 0.05]), rng, test)


def test_an_ordinary_box_is_held_in_every_pull_unless_it_is_slippery_heavy_or_weakly_gripped() -> None:
    held = hold()
    assert held.shape == (2, len(PULLS)) and held.all()
    np.testing.assert_array_equal(hold(), held)
    assert not hold(object_friction=0.05, finger_friction=0.05, mass_kg=1.0).any()
    assert not hold(mass_kg=20.0).any()
    assert not hold(grip_force_n=1.0, mass_kg=1.0).any()
    assert not hold(pull_mps2=float("nan")).any()


def test_friction_decides_where_coulomb_says() -> None:
    """Two pads of 40 N and friction mu, the mean of both materials, carry 80 mu newtons."""
    mass_kg, friction = 1.0, 0.3
    limit = 2 * 40 * friction / mass_kg
    for share, expected in ((0.7, True), (1.5, False)):
        held = hold(mass_kg, object_friction=friction, finger_friction=friction, pull_mps2=share * limit)
        assert (held == expected).all(), (share, held)


def test_a_score_depends_on_its_block_alone() -> None:
    """The first of many hands end as they do among as many as are scored together."""
    box = box_model("box", (0.06, 0.04, 0.08))
    T, opening_m = np.tile(FROM_ABOVE, (100, 1, 1)), np.full(100, 0.06)
    test = replace(HandTest(), hands_at_once=32, object_friction=0.2, finger_friction=0.5)
    many, few, none = (
        held_trials(box.convex_parts_m, 1.0, GRIPPER, T[:n], opening_m[:n], np.random.default_rng(0), test)
        for n in (100, 64, 0)
    )
    np.testing.assert_array_equal(many[:64], few)
    assert none.shape == (0, len(PULLS))
