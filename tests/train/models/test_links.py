"""Room of the arm's links: all in free air, none among points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.train.hands.reach import N_ROOMS, obstacles, room_codes
from datagen.train.inputs import F64, U8, Clouds
from datagen.workers.motion import arm_links as module
from datagen.workers.motion.arm_links import arm_links
from datagen.workers.motion.pose_reach import pose_reach, reach_codes
from tests.sim_extra import needs_robots, needs_sim
from tests.workers.motion.test_pose_reach import attained

ROBOTS = [
    pytest.param("panda-scaled", 0.6, marks=needs_sim),
    pytest.param("panda-scaled", 1.0, marks=needs_sim),
    *(pytest.param(name, 1.0, marks=needs_robots) for name in ("ur5", "tiago-pro", "stretch3")),
]


def cloud_of(points_m: F64, target_points: int = 0) -> Clouds[np.ndarray]:
    """One cloud of these points, of which the first are the target's."""
    mask = np.arange(len(points_m)) < target_points
    zero = np.zeros(1, np.float32)
    return Clouds(
        points_m[None].astype(np.float32),
        np.zeros((1, len(points_m), 3), np.uint8),
        mask[None],
        np.array([len(points_m)]),
        zero,
        zero,
    )


def rooms(
    name: str, reach_m: float, points_m: F64, target_points: int = 0, turn: float = 0.0
) -> tuple[U8, U8]:
    """Codes of reach (200, 3) and of room (200, N_ROOMS) at poses that the arm attains, all turned alike."""
    axes, xy, turn_rad, rise = attained(name, None if reach_m == 1.0 else reach_m, 200)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    axes, xy, points_m = axes @ R.T, xy @ R[:2, :2].T, points_m @ R.T
    given = (np.arange(200), xy, turn_rad, rise)
    arm = pose_reach(name, reach_m)
    reach = reach_codes(arm, axes, *given)
    around = obstacles(cloud_of(points_m, target_points)) * 200
    return reach[:, 0], room_codes(arm, arm_links(name), around, axes, reach, given)[:, 0]


@pytest.mark.parametrize(("name", "reach_m"), ROBOTS)
def test_in_free_air_poses_that_are_reached_have_all_room_and_others_no_code(
    name: str, reach_m: float
) -> None:
    reach, found = rooms(name, reach_m, np.zeros((1, 3)), target_points=1)  # the target is no obstacle
    assert found.shape == (200, N_ROOMS) and set(np.unique(found)) <= {0, 255}
    assert not found[reach.min(axis=1) == 0].any()
    assert (found[reach.min(axis=1) > 0] == 255).mean() > 0.7


@pytest.mark.parametrize(("name", "reach_m"), ROBOTS)
def test_points_within_the_arm_leave_it_no_room(name: str, reach_m: float) -> None:
    """The wrist is within 30 cm of the target: a block of points there hits the last links of all arms."""
    axis = np.arange(-0.3, 0.31, 0.03)
    block = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    free, hit = rooms(name, reach_m, np.zeros((1, 3)), 1)[1], rooms(name, reach_m, block)[1]
    assert ((hit > 0) == (free > 0)).all()
    assert hit[free[:, 0] > 0, 0].max() < 128  # the middle: no room
    assert np.median(hit[free > 0]) < 80
    beyond = rooms(name, reach_m, block + [0.0, 0.0, 3.0])[1]
    np.testing.assert_array_equal(beyond, free)


@needs_sim
@pytest.mark.parametrize("angle", [0.3, 2.0])
def test_rooms_turn_with_the_scene(angle: float) -> None:
    shelf = np.random.default_rng(0).uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.13], (3000, 3))
    before, after = (rooms("panda-scaled", 1.0, shelf, turn=t)[1].astype(float) for t in (0.0, angle))
    assert before[before > 0].std() > 20
    # Distances are those of cells of 2.5 cm.
    assert np.abs(after - before)[(before > 0) & (after > 0)].mean() < 12


def test_links_are_sampled_once_on_a_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path))
    sampled = arm_links.__wrapped__("fetch")
    monkeypatch.setattr(module, "_SAMPLES", 0)
    for field, stored, fresh in zip(sampled._fields, arm_links.__wrapped__("fetch"), sampled, strict=True):
        np.testing.assert_array_equal(stored, fresh, err_msg=field, strict=True)
