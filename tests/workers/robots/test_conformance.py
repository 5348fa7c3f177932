"""What every robot must hold, and what its constants must agree with."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize
from scipy.spatial import ConvexHull

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen.schemas.fields import SCHEMAS
from datagen.workers.geometry.transforms import inverse
from datagen.workers.robots import robot_limits
from datagen.workers.robots.hulls import MAX_CORNERS
from datagen.workers.robots.robot import Robot
from tests.workers.robots.robots_under_test import CASES, IDS, opened


@pytest.fixture(params=CASES, ids=IDS)
def robot(request: pytest.FixtureRequest) -> Robot:
    return opened(request.param)


def random_q(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.q_lower_rad, -np.pi), np.minimum(robot.q_upper_rad, np.pi)
    return rng.uniform(low, high, (count, len(low)))


def test_lengths_and_limits(robot: Robot) -> None:
    joints, links = len(robot.joint_names), len(robot.link_names)
    in_records = next(f for f in SCHEMAS["plan"].sample_fields if f.name == "q_grasp_rad")
    assert (joints,) == SCHEMAS["plan"].shape(in_records, 1)[1:]
    assert len(set(robot.joint_names)) == joints and len(set(robot.link_names)) == links
    for values in (robot.q_lower_rad, robot.q_upper_rad, robot.speed_limit_radps):
        assert values.shape == (joints,) and np.isfinite(values).all()
    assert (robot.q_lower_rad < robot.q_upper_rad).all() and (robot.speed_limit_radps > 0).all()
    assert len(robot.link_parts_m) == links == len(robot.link_meshes())
    assert robot.stiffness > 0 and robot.damping > 0 and robot.force_limit_n > 0
    limits = robot_limits(robot.name)
    assert robot.reach_m == pytest.approx(np.clip(robot.reach_m, *limits.reach_m), abs=1e-3)
    assert robot.base_radius_m == limits.base_radius_m


def test_parts_are_convex_and_small(robot: Robot) -> None:
    for parts in (*robot.link_parts_m, robot.gripper.parts_at(robot.gripper.max_opening_m)):
        assert parts
        for part in parts:
            assert part.dtype == np.float32 and 4 <= len(part) <= MAX_CORNERS
            assert len(ConvexHull(part).vertices) >= 0.8 * len(part)


def test_homes_are_tucked_and_free(robot: Robot) -> None:
    homes = robot.homes_rad
    assert len(homes) >= 6
    assert ((homes > robot.q_lower_rad) & (homes < robot.q_upper_rad)).all()
    assert not any(robot.collides_itself(q) for q in homes)
    turns = homes[:, 0]
    assert turns.min() < -1.2 and turns.max() > 1.2  # to both sides
    for q in homes:
        T = robot.T_base_link(q)
        links = [(T[k], np.concatenate(parts)) for k, parts in enumerate(robot.link_parts_m) if k > 0]
        points = np.concatenate([corners @ L[:3, :3].T + L[:3, 3] for L, corners in links])
        assert np.hypot(points[:, 0], points[:, 1]).max() < max(0.45 * robot.reach_m, 0.2)
        # Above the pedestal, or 30 cm above the floor.
        assert points[:, 2].min() > (0.0 if robot.base_radius_m is None else 0.3 - robot.base_height_m)
        if abs(q[0]) < 0.1:
            assert points[:, 0].max() < 0.3  # what stands in front is a table


def test_reach_is_the_largest_distance(robot: Robot) -> None:
    def distance(q: np.ndarray) -> float:
        return float(np.linalg.norm(robot.T_base_tcp(q)[:3, 3] - robot.shoulder_m))

    q = random_q(robot, 2000)
    far = np.array([distance(x) for x in q])
    bounds = list(zip(robot.q_lower_rad, robot.q_upper_rad, strict=True))
    starts = q[np.argsort(far)[-4:]]
    best = max(-minimize(lambda x: -distance(x), start, bounds=bounds).fun for start in starts)
    assert far.max() <= robot.reach_m + 1e-5
    assert abs(best - robot.reach_m) < 0.01


def test_the_wrist_is_never_beyond_its_reach_and_no_joints_lead_beyond(robot: Robot) -> None:
    q = random_q(robot, 2000)
    T = np.array([robot.T_base_tcp(x) for x in q])
    low, high = robot.q_lower_rad, robot.q_upper_rad
    assert robot.is_wrist_within_reach(T).all()
    # It comes nearly as far out.
    assert not robot.is_wrist_within_reach(T, beyond_m=-0.1 * robot.reach_m).all()
    T[:, :3, 3] = robot.shoulder_m + 1.3 * (T[:, :3, 3] - robot.shoulder_m)
    beyond = np.flatnonzero(~robot.is_wrist_within_reach(T))[:200]
    assert len(beyond) > 10
    assert all(robot.ik(T[k], np.clip(q[k], low, high)) is None for k in beyond)


def test_base_frame(robot: Robot) -> None:
    root = robot.T_base_link(robot.homes_rad[0])[0]
    np.testing.assert_allclose(root, robot.T_base_root, atol=1e-12)
    floor = 0.0 if robot.base_radius_m is None else -robot.base_height_m
    assert root[2, 3] == pytest.approx(floor, abs=1e-9)
    if robot.base_radius_m is not None:
        points = np.concatenate(robot.link_parts_m[0]) @ root[:3, :3].T + root[:3, 3]
        # Hulls stand out of the meshes by less than a centimetre.
        assert np.hypot(points[:, 0], points[:, 1]).max() < robot.base_radius_m + 0.01


def test_gripper_agrees_with_the_links(robot: Robot) -> None:
    gripper = robot.gripper
    q = robot.homes_rad[0]
    T, tcp = robot.T_base_link(q), robot.T_base_tcp(q)
    hand = gripper.parts_at(gripper.max_opening_m)
    of_links = [part @ T[k, :3, :3].T + T[k, :3, 3] for k in (-3, -2, -1) for part in robot.link_parts_m[k]]
    for ours, theirs in zip(hand, of_links, strict=True):
        np.testing.assert_allclose(ours @ tcp[:3, :3].T + tcp[:3, 3], theirs, atol=1e-6)
    left, right = (np.concatenate(parts) for parts in gripper.finger_parts_m)
    assert left[:, 1].min() == pytest.approx(0.0, abs=1e-3) == -right[:, 1].max()
    assert left[:, 1].mean() > 0.005 and right[:, 1].mean() < -0.005
    # Pads lie around the TCP, and nothing of the hand reaches beyond them.
    assert left[:, 2].max() == pytest.approx(gripper.pad_size_m[1] / 2, abs=2e-3)
    palm = np.concatenate(gripper.palm_parts_m)
    assert palm[:, 2].max() == pytest.approx(-gripper.palm_depth_m, abs=1e-6)
    assert gripper.palm_depth_m > gripper.pad_size_m[1] / 2


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_ik_reaches_what_it_returns(robot: Robot, seed: int) -> None:
    q, other = random_q(robot, 2, seed)
    goal = robot.T_base_tcp(q)
    found = robot.ik(goal, other)
    if found is not None:
        assert ((found >= robot.q_lower_rad) & (found <= robot.q_upper_rad)).all()
        off = inverse(goal) @ robot.T_base_tcp(found)
        angle = np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1))
        assert np.linalg.norm(off[:3, 3]) <= 0.0005 + 1e-9 and angle <= np.radians(0.5) + 1e-6
    np.testing.assert_array_equal(robot.ik(goal, q), q)


def test_ik_finds_most_poses_from_near_and_gives_up_on_far_ones(robot: Robot) -> None:
    q = random_q(robot, 100)
    near = np.clip(q + np.random.default_rng(1).normal(0, 0.3, q.shape), robot.q_lower_rad, robot.q_upper_rad)
    found = [robot.ik(robot.T_base_tcp(a), b) for a, b in zip(q, near, strict=True)]
    assert sum(x is not None for x in found) >= 90
    away = robot.T_base_tcp(q[0])
    away[:3, 3] = robot.shoulder_m + (0.0, 0.0, robot.reach_m + 0.02)
    assert all(robot.ik(away, b) is None for b in near)


def test_self_pairs_are_found_from_the_geometry(robot: Robot) -> None:
    names = robot.link_names
    pairs = {(names[a], names[b]) for a, b in robot.self_pairs}
    assert all(a < b for a, b in robot.self_pairs)
    arm = names[: len(robot.joint_names) + 1]
    # All of the arm but neighbours is watched, and the hand against all that its wrist can bring it to.
    for k, link in enumerate(arm):
        for other in arm[k + 2 :]:
            assert (link, other) in pairs
        for part in names[-3:]:
            assert ((link, part) in pairs) == (k <= 5)
    assert not {(a, b) for a in names[-3:] for b in names[-3:]} & pairs


def test_self_collision_agrees_with_separating_planes(robot: Robot) -> None:
    # Fingers are checked as one hull each.
    parts = [*robot.link_parts_m[:-2], *((np.concatenate(p),) for p in robot.link_parts_m[-2:])]
    for q in random_q(robot, 12, seed=3):
        T = robot.T_base_link(q)
        placed = [[part @ T[k, :3, :3].T + T[k, :3, 3] for part in body] for k, body in enumerate(parts)]
        gaps = [separation(one, two) for a, b in robot.self_pairs for one in placed[a] for two in placed[b]]
        if min(gaps) > 1e-4:
            assert not robot.collides_itself(q)
        elif min(gaps) <= 0.0:
            assert robot.collides_itself(q)


def separation(one: np.ndarray, two: np.ndarray) -> float:
    """Positive where a plane separates two point sets: the largest margin over normals in a unit cube."""
    radii = sum(np.linalg.norm(points - points.mean(0), axis=1).max() for points in (one, two))
    if np.linalg.norm(one.mean(0) - two.mean(0)) > radii:
        return 1.0
    # max m with n . x + m <= d <= n . y - m, |n_i| <= 1
    rows = [[*x, -1.0, 1.0] for x in one] + [[*(-y), 1.0, 1.0] for y in two]
    result = linprog([0, 0, 0, 0, -1], rows, np.zeros(len(rows)), bounds=[(-1, 1)] * 3 + [(None, None)] * 2)
    return float(-result.fun) if -result.fun > 1e-9 else 0.0
