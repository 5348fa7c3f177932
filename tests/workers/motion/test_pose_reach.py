"""How easily an arm reaches poses: what its joints attain counts, what is too far does not, both rolls do."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.train.hands.sizes import measured_hand
from datagen.workers.motion import pose_reach as module
from datagen.workers.motion.arm_links import RADIUS, TREE
from datagen.workers.motion.measured_reach import link_spheres, measured_arm, reaches_of
from datagen.workers.motion.pose_reach import known_arm, pose_reach, reach_codes
from datagen.workers.motion.reach_cells import cells_of
from datagen.workers.motion.reach_map import cell_of
from datagen.workers.robots import ROBOTS as NAMES
from datagen.workers.robots import gripper_of, open_largest, open_robot, robot_digest, robot_limits
from scripts.known_arms import size_row
from tests.sim_extra import needs_robots, needs_sim

# An arm with axes along y, one without an upright first joint, and one whose base turns.
ROBOTS = [
    pytest.param("panda-scaled", 0.6, marks=needs_sim),
    pytest.param("panda-scaled", 0.95, marks=needs_sim),
    *(pytest.param(name, None, marks=needs_robots) for name in ("ur5", "tiago-pro", "stretch3")),
]


def attained(name: str, reach_m: float | None, count: int) -> tuple[np.ndarray, ...]:
    """Poses (count, 1, 3, 3) that random joints attain, and bases: xy, turn, rise of the target."""
    robot = open_largest(name) if reach_m is None else open_robot(name, reach_m, 0.5)
    rng = np.random.default_rng(0)
    low, high = np.maximum(robot.q_lower_rad, -np.pi), np.minimum(robot.q_upper_rad, np.pi)
    T = np.stack([robot.T_base_tcp(rng.uniform(low, high)) for _ in range(count)])
    # The target is where the TCP is, the base anywhere around it, with any heading.
    yaw_rad = rng.uniform(-np.pi, np.pi, count)
    c, s, zero = np.cos(yaw_rad), np.sin(yaw_rad), np.zeros(count)
    R = np.stack(
        [np.stack([c, -s, zero], 1), np.stack([s, c, zero], 1), np.stack([zero, zero, zero + 1], 1)], 1
    )
    xy = -np.einsum("nij,nj->ni", R, T[:, :3, 3])[:, :2]
    axes = np.stack(
        [np.zeros((count, 3)), *(np.einsum("nij,nj->ni", R, T[:, :3, k]) for k in (2, 1))], axis=1
    )
    return axes[:, None], xy, yaw_rad - np.arctan2(-xy[:, 1], -xy[:, 0]), T[:, 2, 3]


@pytest.mark.parametrize(("name", "reach_m"), ROBOTS)
def test_poses_that_joints_attain_have_codes_and_far_ones_none(name: str, reach_m: float | None) -> None:
    axes, xy, turn, rise = attained(name, reach_m, 300)
    arm, row = pose_reach(name, reach_m or 1.0), np.arange(300)
    codes = reach_codes(arm, axes, row, xy, turn, rise)
    assert codes.shape == (300, 1, 3)
    assert (codes[:, 0, 0] > 0).mean() > 0.98
    # Half a metre higher many of these poses are out of reach.
    assert reach_codes(arm, axes, row, xy, turn, rise + 0.5)[:, 0, 0].mean() < 0.9 * codes[:, 0, 0].mean()
    assert not reach_codes(arm, axes, row, xy + 5.0, turn, rise).any()
    assert not reach_codes(arm, axes, row, xy, turn, rise - 4.0).any()
    for wrong in (np.nan, np.inf, -1e30):
        assert not reach_codes(arm, axes, row, np.full_like(xy, wrong), turn, rise).any()
        assert not reach_codes(arm, axes, row, xy, turn, np.full_like(rise, wrong)).any()
    assert not reach_codes(arm, axes, row, xy, np.full_like(turn, np.nan), rise).any()
    flipped = axes * np.array([1.0, 1.0, -1.0])[:, None]  # the fingers are interchangeable
    np.testing.assert_array_equal(reach_codes(arm, flipped, row, xy, turn, rise), codes)
    assert not reach_codes(arm, np.zeros_like(axes), row, xy, turn, rise).any()  # no pose


@needs_robots
@pytest.mark.parametrize("name", NAMES)
def test_the_shipped_hands_and_maps_are_those_of_the_robots_files(name: str) -> None:
    """`python -m scripts.known_arms` writes them. Samples at borders may lie beyond them elsewhere."""
    digest, reaches_m = robot_digest(name), reaches_of(name)
    known = known_arm(f"{name}@{digest}" if digest else name)
    assert not known_arm(f"{name}@{'0' * 64}") and not known_arm("ur10.toml")
    np.testing.assert_array_equal(known["reach_m"], reaches_m)
    np.testing.assert_allclose(known["hand"], measured_hand(gripper_of(name)), atol=1e-6)
    for step in {0, len(reaches_m) - 1}:
        arm = measured_arm(name, float(reaches_m[step]))
        np.testing.assert_allclose(known["size"][step], size_row(arm), atol=1e-6)
        assert (known["code"] != arm.code).mean() < 1e-3
    if (limits := robot_limits(name)).base_radius_m is not None:
        np.testing.assert_array_equal(
            known["base_m"], [*(limits.base_height_m or ())[:1], limits.base_radius_m]
        )
        np.testing.assert_array_equal(known["footprint_m"], limits.footprint_m)
    tree, radius_m = link_spheres(name)
    np.testing.assert_allclose(known[RADIUS], radius_m, atol=1e-6)
    for field, values in tree._asdict().items():
        np.testing.assert_allclose(known[TREE + field], values, atol=1e-6)


@needs_sim
@pytest.mark.parametrize("reach_m", [0.3, 0.57, 1.0, 1.5])
def test_scores_without_the_robots_files_are_the_same(
    reach_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    axes, xy, turn, rise = attained("panda-scaled", 1.0, 100)
    places = (axes, np.arange(100), xy, turn, rise)
    shipped = reach_codes(pose_reach.__wrapped__("panda-scaled", reach_m), *places)
    monkeypatch.setattr(module, "known_arm", lambda name: {})
    measured = reach_codes(pose_reach.__wrapped__("panda-scaled", reach_m), *places)
    np.testing.assert_array_equal(shipped, measured)


@needs_sim
def test_an_arm_beyond_the_range_of_its_family_is_scaled_further() -> None:
    axes, xy, turn, rise = attained("panda-scaled", 1.0, 100)
    row = np.arange(100)
    codes = reach_codes(pose_reach("panda-scaled", 1.0), axes, row, xy, turn, rise)
    longer = reach_codes(pose_reach("panda-scaled", 1.5), axes, row, 1.5 * xy, turn, 1.5 * rise)
    np.testing.assert_array_equal(longer[:, :, 0], codes[:, :, 0])


@pytest.mark.parametrize("turns", [True, False])
def test_cells_of_many_hands_are_those_of_each(turns: bool) -> None:
    rng = np.random.default_rng(0)
    a, c = rng.normal(size=(2, 500, 3))
    a[:50] = np.eye(3)[rng.integers(0, 3, 50)] * rng.choice([-1, 1], (50, 1))  # borders of cells
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    azimuth = rng.uniform(-np.pi, np.pi, 500)
    each = [cell_of(0.0, -1.0, float(t), p, q, turns) for t, p, q in zip(azimuth, a, c, strict=True)]
    np.testing.assert_array_equal(cells_of(a.T, c.T, None if turns else azimuth), each)
