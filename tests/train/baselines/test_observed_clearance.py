"""Room around a base, from points alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from datagen.schemas.specification import PANDA_REACH_M
from datagen.train.baselines.observed_clearance import FAR_M, observed_clearance_m
from datagen.train.inputs import Batch
from tests.train.baselines.scenes import make_batch, moved, take


def batch_with(points_m: list[list[float]], base_xy_m: list[list[float]]) -> Batch[Any]:
    """A target 0.8 m above the floor, an arm of 1 m mounted at 0.7 m, and bases."""
    batch = take(make_batch(0, n_scenes=1, per_robot=len(base_xy_m)), np.arange(len(base_xy_m)))
    points = np.array([points_m], np.float32)
    clouds = replace(
        batch.clouds,
        points_m=points,
        rgb=np.zeros(points.shape, np.uint8),
        target_mask=np.zeros(points.shape[:2], np.bool_),
        n_points=np.array([points.shape[1]]),
        target_height_m=np.array([0.8], np.float32),
    )
    mounts, reach = np.full(2, 0.7, np.float32), np.ones(2, np.float32)
    robots = replace(batch.robots, base_height_m=mounts, arm_reach_m=reach)
    return moved(replace(batch, clouds=clouds, robots=robots), np.array(base_xy_m))


def test_it_is_the_distance_to_the_nearest_point_beside_the_base() -> None:
    batch = batch_with([[0, 0, -0.4], [0, 0.3, -0.4]], [[0.6, 0], [0.1, 0], [2.0, 0]])
    np.testing.assert_allclose(observed_clearance_m(batch), [0.35, -0.15, FAR_M], atol=1e-6)


@pytest.mark.parametrize("height_m", [-0.79, 0.0, np.nan])  # floor, above the mount, not a number
def test_other_points_leave_all_free(height_m: float) -> None:
    assert (observed_clearance_m(batch_with([[0, 0, height_m]], [[0.1, 0], [0.5, 0]])) == FAR_M).all()


def test_narrow_bases_of_short_arms_have_more_room() -> None:
    batch = batch_with([[0, 0, -0.4]], [[0.5, 0]])
    short = replace(batch, robots=replace(batch.robots, arm_reach_m=np.full(2, 0.5, np.float32)))
    np.testing.assert_allclose(
        observed_clearance_m(short) - observed_clearance_m(batch), 0.25 * (1 - 0.5 / PANDA_REACH_M), atol=1e-6
    )


def test_more_points_leave_less_room_and_order_does_not_matter() -> None:
    batch = make_batch(3)
    room = observed_clearance_m(batch)
    fewer = replace(batch, clouds=replace(batch.clouds, n_points=batch.clouds.n_points // 2))
    assert (observed_clearance_m(fewer) >= room).all() and (observed_clearance_m(fewer) > room).any()
    rows = np.random.default_rng(0).permutation(len(batch))
    assert np.array_equal(observed_clearance_m(take(batch, rows)), room[rows])
