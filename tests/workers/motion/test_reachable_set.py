"""Reachable sets: they hold what a hand reaches and little else, and follow from the robot alone."""

from __future__ import annotations

import subprocess
import sys
from hashlib import sha256

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from datagen.schemas.errors import InputError
from datagen.workers.content_cache import CacheFolder, cache_folder
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.kinematics.tree import KinematicTree, frame_poses
from datagen.workers.motion import reachable_sampling
from datagen.workers.motion.reachable_sampling import needs_set, reachable_set, reachable_set_of
from datagen.workers.motion.reachable_set import (
    AZIMUTHS,
    LEVELS,
    SECTORS,
    direction_parts,
    part_directions,
)
from datagen.workers.robots import open_largest
from datagen.workers.robots.reach import farthest_m
from tests.sim_extra import named_robots, needs_sim
from tests.workers.kinematics.trees import random_tree

pytestmark = needs_sim

OF_ONE_REACH = [param for param in named_robots() if param.values[0] != "panda-scaled"]


def tcp_m(tree: KinematicTree, q: F64) -> F64:
    return frame_poses(tree, q, tcp_only=True)[:, 0, :3, 3]


def farthest_along(tree: KinematicTree, ways: F64) -> F64:
    """Positions (W, 3) of the TCP that lie far along ways (W, 3): coordinate ascent from random positions."""
    rng, rows = np.random.default_rng(3), np.arange(len(ways))
    q = rng.uniform(tree.lower, tree.upper, (64, len(ways), len(tree.lower)))

    def along(q: F64) -> F64:
        return (tcp_m(tree, q.reshape(-1, q.shape[-1])).reshape(*q.shape[:2], 3) * ways).sum(2)

    best, width = q[along(q).argmax(0), rows], tree.upper - tree.lower
    for _ in range(12):
        for k in range(len(width)):
            tried = np.repeat(best[None], 17, axis=0)
            tried[..., k] += width[k] * np.linspace(-1, 1, 17)[:, None]
            tried = np.clip(tried, tree.lower, tree.upper)
            best = tried[along(tried).argmax(0), rows]
        width = width / 2
    return tcp_m(tree, best)


@pytest.mark.parametrize("name", OF_ONE_REACH)
def test_a_robot_reaches_no_position_outside_its_set(name: str) -> None:
    robot, found, rng = open_largest(name), reachable_set_of(name), np.random.default_rng(7)
    q = rng.uniform(robot.q_lower_rad, robot.q_upper_rad, (20_000, len(robot.q_lower_rad)))
    assert found.holds(tcp_m(robot.tree, q), or_next=True).all()
    assert found.holds(tcp_m(robot.tree, q)).mean() > 0.999
    ways = rng.normal(size=(30, 3))
    border_m = farthest_along(robot.tree, ways / np.linalg.norm(ways, axis=1, keepdims=True))
    assert found.holds(border_m, or_next=True).all()
    assert np.hypot(*border_m[:, :2].T).max() <= found.farthest_m
    outside_m = (
        robot.shoulder_m
        + (border_m - robot.shoulder_m)
        * ((robot.reach_m + 3 * found.cell_m) / np.linalg.norm(border_m - robot.shoulder_m, axis=1))[:, None]
    )
    assert not found.holds(outside_m, or_next=True).any()


@pytest.mark.parametrize("name", OF_ONE_REACH)
def test_a_robot_comes_near_each_position_in_its_set(name: str) -> None:
    robot, found, rng = open_largest(name), reachable_set_of(name), np.random.default_rng(8)
    tree = robot.tree
    held_m = robot.shoulder_m + rng.uniform(-robot.reach_m, robot.reach_m, (400, 3))
    held_m = held_m[found.holds(held_m)][:8]
    q = rng.uniform(tree.lower, tree.upper, (20_000, len(tree.lower)))
    at_m = tcp_m(tree, q)
    for goal_m in held_m:
        start = np.clip(
            q[np.linalg.norm(at_m - goal_m, axis=1).argmin()], tree.lower + 1e-9, tree.upper - 1e-9
        )

        def gap_m(x: F64, goal_m: F64 = goal_m) -> F64:
            return tcp_m(tree, x[None])[0] - goal_m

        left_m = np.linalg.norm(least_squares(gap_m, start, bounds=(tree.lower, tree.upper)).fun)
        # The other corner of its cell, or of the next one where a gap was filled.
        round_m = 2 * np.pi / SECTORS * np.hypot(*goal_m[:2])
        assert left_m <= 2 * np.linalg.norm([found.cell_m, found.cell_m, round_m])


@given(seed=st.integers(0, 2**32 - 1), more=st.lists(st.booleans(), max_size=3))
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_lifts_and_turns_below_any_tree_bring_the_set_with_them(
    monkeypatch: pytest.MonkeyPatch, seed: int, more: list[bool]
) -> None:
    """Joints along the mount's vertical are not sampled: with them stands what is reached by sampling all."""
    monkeypatch.setattr(reachable_sampling, "_SAMPLES", 1 << 18)
    monkeypatch.setattr(reachable_sampling, "_CACHE", CacheFolder("reachable-random", 1))
    rng = np.random.default_rng(seed)
    tree = random_tree(rng)
    if tree.frame_joint[-1] < 0:
        return
    n, z = len(more), np.tile([0.0, 0.0, 1.0], (len(more), 1)) * rng.choice([-1.0, 1.0], (len(more), 1))
    span = rng.uniform(0.1, 1.5, n)
    tree = KinematicTree(
        np.concatenate([np.arange(n) - 1, np.where(tree.parent < 0, n - 1, tree.parent + n)]),
        np.concatenate([[yaw_pose(0.0, 0.0, h, 0.0) for h in rng.uniform(0, 0.3, n)], tree.T_parent_joint])
        if n
        else tree.T_parent_joint,
        np.concatenate([z, tree.axis]),
        np.concatenate([np.array(more, np.bool_), tree.slides[tree.coordinate]]),
        np.concatenate([np.arange(n), tree.coordinate + n]),
        np.concatenate([rng.choice([1.0, -0.5], n), tree.ratio]),
        np.concatenate([np.zeros(n), tree.offset]),
        np.concatenate([-span, tree.lower]),
        np.concatenate([span, tree.upper]),
        np.where(tree.frame_joint < 0, -1, tree.frame_joint + n),
        tree.T_joint_frame,
    )
    found = reachable_set(tree, np.zeros(3), farthest_m(tree, np.zeros(3)) * 1.01)
    q = rng.uniform(tree.lower, tree.upper, (4000, len(tree.lower)))
    missed = ~found.holds(tcp_m(tree, q), or_next=True)
    # Joints that slide far in three directions reach more cells than there are samples.
    assert missed.mean() < 0.01


def test_directions_lie_where_the_hand_points() -> None:
    name = "panda"
    robot, found, rng = open_largest(name), reachable_set_of(name), np.random.default_rng(9)
    q = rng.uniform(robot.q_lower_rad, robot.q_upper_rad, (20_000, 7))
    T = frame_poses(robot.tree, q, tcp_only=True)[:, 0]
    x, y, z = T[:, :3, 3].T
    level, azimuth = (p.astype(int) for p in direction_parts(T[:, :3, 2], np.arctan2(y, x)))
    ring, layer = (
        (np.hypot(x, y) / found.cell_m).astype(int),
        ((z - found.lowest_m) / found.cell_m).astype(int),
    )
    ahead = np.abs(np.arctan2(y, x)) < np.pi / SECTORS
    there = found.directions_at(0.0)[ring, layer, level % LEVELS, azimuth % AZIMUTHS]
    assert ahead.sum() > 100 and there[ahead].mean() > 0.9
    assert set(np.unique(there)) <= {0.0, 1.0}
    level, azimuth = direction_parts(part_directions().reshape(-1, 3))
    np.testing.assert_allclose(level, np.repeat(np.arange(LEVELS) + 0.5, AZIMUTHS))
    np.testing.assert_allclose(azimuth, np.tile(np.arange(AZIMUTHS) + 0.5, LEVELS))


AGAIN = """
from hashlib import sha256
from datagen.workers.content_cache import CacheFolder
from datagen.workers.motion import reachable_sampling
reachable_sampling._CACHE = CacheFolder("reachable-again", 9)
for name in ("fetch", "xarm7"):
    print(sha256(reachable_sampling.reachable_set_of(name).sectors.tobytes()).hexdigest())
"""


def test_a_set_is_the_same_from_any_process_in_any_order_and_from_a_damaged_cache(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = ("xarm7", "fetch")
    before = {name: reachable_set_of(name) for name in names}
    again = subprocess.run([sys.executable, "-c", AGAIN], capture_output=True, text=True, check=True)
    digests = [sha256(before[n].sectors.tobytes()).hexdigest() for n in reversed(names)]
    assert again.stdout.split() == digests
    files = list((cache_folder() / "reachable-again").iterdir())
    assert len(files) == 2
    for file in files:
        file.write_bytes(file.read_bytes()[:1000])
    monkeypatch.setattr(reachable_sampling, "_CACHE", CacheFolder("reachable-again", 9))
    reachable_sampling.sampled_set.cache_clear()
    np.testing.assert_array_equal(reachable_set_of("fetch").sectors, before["fetch"].sectors)
    reachable_sampling.sampled_set.cache_clear()
    monkeypatch.setattr(reachable_sampling, "_sampled", None)  # the file was written again
    np.testing.assert_array_equal(reachable_set_of("fetch").sectors, before["fetch"].sectors)


def test_robots_that_a_distance_judges_rightly_keep_it() -> None:
    assert not any(map(needs_set, ("panda", "xarm7", "panda-scaled")))
    assert needs_set("fetch")
    with pytest.raises(InputError, match=r"panda-scaled: is scaled to reaches from 0\.3 to 1 m"):
        reachable_set_of("panda-scaled")
