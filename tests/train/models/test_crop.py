"""The crop: which points a robot is given, where they lie and how they are coloured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from datagen.train.models.crop import crop_clouds
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


def test_clouds_without_room_for_points_give_empty_crops():
    clouds, _, robots = drawn_tables(0, points=0)
    crop = crop_clouds(clouds, robots, 8)
    assert crop.points_m.shape == (3, 8, 3)
    assert not crop.valid.any()
