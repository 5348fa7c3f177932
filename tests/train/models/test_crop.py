"""The crop: which points a robot is given, where they lie and how they are coloured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from datagen.train.models.crop import ball_query, crop_clouds, farthest_points
from datagen.workers.rendering.cloud import farthest_points as stored_order
from tests.train.models.made_batches import drawn_tables


def test_the_crop_equals_a_plain_loop():
    clouds, _, robots = drawn_tables(3, scenes=2, robots=5, points=60)
    clouds = replace(clouds, n_points=torch.tensor([60, 41]))
    robots = replace(robots, arm_reach_m=torch.tensor([0.8, 0.2, 0.1, 0.05, 0.3]))
    crop = crop_clouds(clouds, robots, 16)
    for r in range(5):
        s = int(robots.cloud_row[r])
        points = clouds.points_m[s, : clouds.n_points[s]]
        inside = points.norm(dim=1) <= robots.arm_reach_m[r]
        n = min(int(inside.sum()), 16)
        assert crop.valid[r].tolist() == [True] * n + [False] * (16 - n)
        rise = clouds.target_height_m[s] - robots.base_height_m[r]
        assert crop.target_rise_m[r] == rise
        shifted = points[inside][:n] + torch.tensor([0, 0, rise])
        torch.testing.assert_close(crop.points_m[r, :n], shifted)
        target = clouds.target_mask[s, : clouds.n_points[s]][inside][:n]
        assert torch.equal(crop.target_mask[r, :n], target)
        rgb = clouds.rgb[s, : clouds.n_points[s]][inside][:n] / 255
        rgb[target] = torch.tensor([0, 77, 77]) / 255
        torch.testing.assert_close(crop.rgb[r, :n], rgb)
        assert not crop.points_m[r, n:].any() and not crop.rgb[r, n:].any()
        assert not crop.target_mask[r, n:].any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_left_out(bad: float):
    clouds, _, robots = drawn_tables(0)
    clouds.points_m[0, 3, 1] = bad
    crop = crop_clouds(clouds, robots, 96)
    assert torch.isfinite(crop.points_m).all()
    assert int(crop.valid[0].sum()) == 95


def test_farthest_points_are_those_of_the_stored_order_and_repeated_where_there_are_fewer():
    points = np.random.default_rng(0).normal(size=(3, 50, 3)).astype(np.float32)
    valid = torch.arange(50) < torch.tensor([[50], [20], [3]])
    rows = farthest_points(torch.tensor(points), valid, 16)
    for cloud, n, ours in zip(points, (50, 20, 3), rows, strict=True):
        first = min(n, 16)
        np.testing.assert_array_equal(ours[:first], stored_order(cloud[:n], first))
        assert set(ours.tolist()) == set(ours[:first].tolist())


def test_a_ball_holds_the_first_points_within_its_radius():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(2, 40, 3)).astype(np.float32)
    centres = rng.normal(size=(2, 5, 3)).astype(np.float32)
    valid = np.arange(40) < np.array([[40], [25]])
    rows, found = ball_query(torch.tensor(points), torch.tensor(valid), torch.tensor(centres), 1.1, 6)
    for b in range(2):
        for j in range(5):
            near = np.linalg.norm(points[b] - centres[b, j], axis=1) <= 1.1
            want = np.flatnonzero(near & valid[b])[:6]
            assert found[b, j] == len(want)
            filled = [*want, *[want[0] if len(want) else 0] * (6 - len(want))]
            assert rows[b, j].tolist() == filled
