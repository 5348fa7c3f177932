"""Hand poses at the target: room is seen where it is, and poses turn with the scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.train.hands.poses import FARTHEST, HAND_WIDTH, N_MEASURES, DistanceGrid, hand_poses
from datagen.train.inputs import F32, F64
from datagen.train.models.frames import frames_of
from datagen.train.models.hand_pooling import from_mount

HALF_M = np.array([0.02, 0.08, 0.05])  # a box: only across its narrow side does it fit between the fingers
COUNT = 104
WIDTH, NEARER_FINGER, PALM = 1, 5, 7  # measures
TIPS = 17


def box(seen_from: float = 0.0) -> F32:
    """Points (T, 3) on the top and on two sides of a box, which is turned by `seen_from`."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (240, 3))
    face = np.arange(240) % 3
    points[np.arange(240), face] = 1.0
    return turned(points * HALF_M, seen_from)


def table() -> F32:
    """Points (M, 3) of the surface that the box stands on."""
    x, y = np.meshgrid(np.arange(-0.3, 0.3, 0.008), np.arange(-0.3, 0.3, 0.008))
    return np.stack([x, y, np.full(x.shape, -HALF_M[2])], axis=2).reshape(-1, 3).astype(np.float32)


def turned(points: F64 | F32, angle: float) -> F32:
    c, s = math.cos(angle), math.sin(angle)
    return (points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32)


def parts(poses: F32) -> tuple[F32, F32, F32, F32]:
    """Measures, TCPs, approaches and closing axes."""
    rest = poses[:, N_MEASURES:].reshape(-1, 3, 3)
    return poses[:, :N_MEASURES], rest[:, 0], rest[:, 1], rest[:, 2]


def test_hands_across_the_narrow_side_hold_it_clear_of_the_table():
    measures, tcp, approach, closing = parts(hand_poses(table(), box(), COUNT // 2))
    across = np.abs(closing[:, 0]) > 0.8
    assert across.sum() > 8
    assert (approach[:, 2] < 0.2).all()
    assert (measures[across, TIPS] > 0).all()
    assert (np.linalg.norm(tcp, axis=1) < 0.2).all()
    for axis in (approach, closing):
        np.testing.assert_allclose(np.linalg.norm(axis, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose((approach * closing).sum(1), 0, atol=1e-5)
    # Some hold no more than a wall of it.
    assert abs(float(np.median(measures[across, WIDTH])) - 20 * HALF_M[0]) < 0.15


def test_a_wall_takes_the_room_of_hands_from_its_side_alone():
    y, z = np.meshgrid(np.arange(-0.3, 0.3, 0.008), np.arange(-0.05, 0.3, 0.008))
    wall = np.stack([np.full(y.size, 0.09), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    before, _, approach, _ = parts(hand_poses(table(), box(), COUNT))
    behind = parts(hand_poses(np.concatenate([table(), wall]), box(), COUNT))
    from_wall, from_room = approach[:, 0] < -0.6, approach[:, 0] > 0.6
    walled = behind[2][:, 0] < -0.6
    assert before[from_wall, PALM].max() > 0.5 > behind[0][walled, PALM].max()
    assert behind[0][behind[2][:, 0] > 0.6, PALM].max() > 0.5 * before[from_room, PALM].max()


@settings(max_examples=15, deadline=None)
@given(st.floats(-math.pi, math.pi))
def test_poses_turn_with_the_scene(angle: float):
    measures, tcp, approach, _ = parts(hand_poses(table(), box(), COUNT))
    after = parts(hand_poses(turned(table(), angle), box(angle), COUNT))
    # The order may change where two poses are equally good, so each is held against its nearest.
    for point, way in zip(turned(tcp, angle), turned(approach, angle), strict=True):
        gap = np.linalg.norm(after[1] - point, axis=1) + np.linalg.norm(after[2] - way, axis=1)
        assert gap.min() < 0.02
    assert abs(measures[:, PALM].mean() - after[0][:, PALM].mean()) < 0.03


@pytest.mark.parametrize("others", [np.zeros((0, 3), np.float32), np.full((5, 3), np.nan, np.float32)])
def test_what_was_not_observed_is_no_error(others: F32):
    nothing = np.zeros((0, 3), np.float32)
    assert not hand_poses(others, nothing, 4).any()
    for target in (box()[:1], box()[:3], box()):
        found = hand_poses(others, target, COUNT + 10)
        assert found.shape == (COUNT + 10, HAND_WIDTH)
        assert np.isfinite(found).all()
        assert found[:COUNT].any(axis=1).all()
        assert not found[COUNT:].any()


def test_features_from_the_mount_are_those_of_the_mirrored_scene():
    poses = torch.from_numpy(hand_poses(table(), box(), COUNT))
    axes = poses[None, :, N_MEASURES:].unflatten(2, (3, 3))
    flip = torch.tensor([1.0, -1.0, 1.0])
    base, rest = torch.tensor([[0.5, 0.3]]), [torch.tensor([v]) for v in (0.2, 0.4, 0.8, 0.05)]
    here = from_mount(axes, frames_of(base, *rest))
    there = from_mount(axes * flip, frames_of(base * flip[:2], *rest))
    torch.testing.assert_close(here, there, atol=1e-5, rtol=1e-4)


LOW_M, SHAPE, CELL_M = np.array([-0.3, -0.1, 0.0]), (30, 14, 9), 0.02
CENTRES_M = LOW_M + CELL_M * (np.argwhere(np.ones(SHAPE)) + 0.5)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 40))
def test_distances_are_those_of_every_pair_of_cells(seed: int, count: int):
    held = CENTRES_M[np.random.default_rng(seed).integers(0, len(CENTRES_M), count)]
    grid = DistanceGrid(held, LOW_M, SHAPE, CELL_M)
    each = np.linalg.norm(CENTRES_M[:, None] - held, axis=2).min(1)
    np.testing.assert_allclose(grid(CENTRES_M, -1), np.minimum(each, FARTHEST * CELL_M), atol=1e-6)


def test_points_outside_and_points_that_are_no_numbers_are_left_out():
    bad = np.array([[np.nan, 0, 0], [np.inf, 0, 0.01], [5.0, 0.0, 0.0], [0.0, 0.0, -0.01]])
    grid = DistanceGrid(bad, LOW_M, SHAPE, CELL_M)
    assert np.ptp(grid(CENTRES_M, -1)) == 0
    np.testing.assert_array_equal(grid(CENTRES_M[:1] + 1.0, 0.1), np.array([0.1], np.float32))
