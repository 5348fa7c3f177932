"""Maps of arms, free directions of approach, and the shares of them that base poses reach."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.baselines.reachability import Reachability
from datagen.train.baselines.reachability_map import (
    AZIMUTHS,
    free_approaches,
    part_directions,
    reachability_map,
)
from datagen.train.inputs import Batch, is_clear
from tests.sim_extra import needs_sim
from tests.train.baselines.scenes import make_batch, moved

pytestmark = needs_sim

REACH_M = 0.8


def batch_of_one_arm(seed: int = 0, reach_m: float = REACH_M) -> Batch[Any]:
    batch = make_batch(seed, n_scenes=2)
    arms = np.full_like(batch.robots.arm_reach_m, reach_m)
    return replace(batch, robots=replace(batch.robots, arm_reach_m=arms))


def turned_about_z(batch: Batch[Any], angle: float) -> Batch[Any]:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    clouds = replace(batch.clouds, points_m=(batch.clouds.points_m @ turn.T).astype(np.float32))
    return replace(moved(batch, batch.candidates.base_xy_m @ turn[:2, :2].T), clouds=clouds)


def test_the_map_ends_at_the_reach_and_holds_both_ways_to_a_point_beside_the_mount() -> None:
    found = reachability_map("panda-scaled", REACH_M)
    assert found.reachable.min() >= 0 and found.reachable.max() <= 1 + 1e-6
    far = found.at(np.array([1.05, 0.0, 0.5]), np.array([0.3, 1.5, -1.2]))
    assert (far == 0).all()
    (near,) = found.at(np.array([0.5]), np.array([0.3]))
    z = part_directions()[..., 2]
    assert near[z < -0.5].mean() > 0.5  # from above
    ahead = np.abs(part_directions()[..., 0]) > 0.7
    assert (
        near[ahead & (part_directions()[..., 0] > 0)].mean()
        > near[ahead & (part_directions()[..., 0] < 0)].mean()
    )


def test_a_table_blocks_directions_from_below_and_more_points_never_free_one() -> None:
    gripper = reachability_map("panda-scaled", REACH_M).gripper
    side = np.linspace(-0.3, 0.3, 31)
    table = np.stack([*np.meshgrid(side, side), np.full((31, 31), -0.06)], axis=2).reshape(-1, 3)
    directions = part_directions()
    free = free_approaches(table.astype(np.float32), directions, gripper)
    assert not free[directions[..., 2] > 0.2].any() and free[directions[..., 2] < -0.8].all()
    nothing = np.array([[np.nan, 0, 0], [5, 0, 0]], np.float32)
    assert free_approaches(nothing, directions, gripper).all()
    points = np.random.default_rng(0).uniform(-0.25, 0.25, (40, 3)).astype(np.float32)
    left = [free_approaches(points[:n], directions, gripper) for n in (0, 3, 10, 40)]
    assert left[0].all() and left[1].sum() < left[0].sum()
    assert all(not (more & ~fewer).any() for fewer, more in pairwise(left))


def test_scores_are_shares_and_those_beyond_the_reach_are_zero() -> None:
    batch, rated = batch_of_one_arm(), Reachability()
    score, clear = rated.score(batch), is_clear(batch)
    assert (score[~clear] == -1).all() and ((score[clear] >= 0) & (score[clear] <= 1 + 1e-6)).all()
    assert score[clear].max() > 0.2
    far = moved(batch, 3 * batch.candidates.base_xy_m + np.sign(batch.candidates.base_xy_m))
    assert (rated.score(far)[clear] == 0).all()


@pytest.mark.parametrize("parts", [1, 5])
def test_turning_the_scene_by_whole_parts_changes_no_score(parts: int) -> None:
    batch = batch_of_one_arm(1)
    turned = turned_about_z(batch, parts * 2 * np.pi / AZIMUTHS)
    np.testing.assert_allclose(Reachability().score(turned), Reachability().score(batch), atol=2e-3)


def test_an_arm_is_known_by_its_reach() -> None:
    xarm = batch_of_one_arm(2, reach_m=0.863)
    assert np.array_equal(Reachability().score(xarm), Reachability(("xarm7",)).score(xarm))
    assert not np.array_equal(Reachability().score(xarm), Reachability(("panda-scaled",)).score(xarm))
    with pytest.raises(InputError, match=r"none of xarm7 has the reach 0\.800"):
        Reachability(("xarm7",)).score(batch_of_one_arm())


def test_the_cut_is_fitted_among_clear_candidates() -> None:
    batch = batch_of_one_arm(3)
    score = Reachability().score(batch)
    label = (score > 0.4).astype(np.int64)
    assert 0 < label.sum() < len(label)
    fitted = Reachability().fit([replace(batch, label=label)])
    assert np.array_equal(score >= fitted.threshold, label == 1)
