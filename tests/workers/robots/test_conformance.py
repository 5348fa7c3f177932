"""What every robot must hold, and what its constants must agree with."""

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize
from scipy.spatial import ConvexHull

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.geometry.transforms import inverse
from datagen.workers.kinematics.tree import frame_poses
from datagen.workers.robots import robot_limits
from datagen.workers.robots.arm_chain import FEWEST, MOST, TURN
from datagen.workers.robots.assembly import read_trees
from datagen.workers.robots.hulls import MAX_CORNERS, polyhedron
from datagen.workers.robots.links import position_of
from datagen.workers.robots.robot import Robot
from tests.workers.robots.robots_under_test import CASES, opened


@pytest.fixture(params=CASES)
def robot(request: pytest.FixtureRequest) -> Robot:
    return opened(request.param)


def random_q(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.q_lower_rad, -np.pi), np.minimum(robot.q_upper_rad, np.pi)
    return rng.uniform(low, high, (count, len(low)))


def test_lengths_and_limits(robot: Robot) -> None:
    joints, links = len(robot.joint_names), len(robot.link_names)
    assert FEWEST <= joints <= MOST
    assert len(set(robot.joint_names)) == joints and len(set(robot.link_names)) == links
    for values in (robot.q_lower_rad, robot.q_upper_rad, robot.speed_limit_radps):
        assert values.shape == (joints,) and np.isfinite(values).all()
    assert (robot.q_lower_rad < robot.q_upper_rad).all() and (robot.speed_limit_radps > 0).all()
    assert len(robot.link_parts_m) == links == len(robot.link_meshes())
    limits = robot_limits(robot.name)
    assert robot.reach_m == pytest.approx(np.clip(robot.reach_m, *limits.reach_m), abs=1e-3)
    assert robot.base_radius_m == limits.base_radius_m


def test_parts_are_convex_and_small(robot: Robot) -> None:
    assert all(robot.link_parts_m[robot.first_hand_link :])
    for parts in (*robot.link_parts_m, robot.gripper.parts_at(robot.gripper.max_opening_m)):
        for part in parts:
            assert part.dtype == np.float32 and 4 <= len(part) <= MAX_CORNERS
            assert len(ConvexHull(part).vertices) >= 0.8 * len(part)


def test_homes_are_tucked_and_free(robot: Robot) -> None:
    homes = robot.homes_rad
    assert len(homes) >= 6
    assert ((homes > robot.q_lower_rad) & (homes < robot.q_upper_rad)).all()
    assert not any(robot.collides_itself(q) for q in homes)
    if not robot.source.keys.arm.tucked:
        for q in homes:  # found by search
            T = robot.T_base_link(q)
            moving = [k for k, parts in enumerate(robot.link_parts_m) if parts and not robot.is_base[k]]
            points = np.concatenate(
                [np.concatenate(robot.link_parts_m[k]) @ T[k, :3, :3].T + T[k, :3, 3] for k in moving]
            )
            within_m = (robot.base_radius_m or 0.2) + 0.35 * robot.reach_m
            assert np.hypot(points[:, 0], points[:, 1]).max() < within_m
            assert points[:, 2].min() > 0.05 - (robot.base_height_m if robot.base_radius_m else 0.0)
        apart = np.abs(homes[:, None] - homes).max(axis=2) + 9 * np.eye(len(homes))
        assert apart.min() > 0.5
        return
    first = int(np.flatnonzero(~robot.slides)[0])  # Fetch's torso comes before
    turns = homes[:, first]
    assert turns.min() < -1.2 and turns.max() > 1.2  # to both sides
    for q in homes:
        T = robot.T_base_link(q)
        # A torso that slides is no part of the arm, and stays in the base.
        arm = [k for k in range(1, len(robot.link_parts_m)) if robot.tree.frame_joint[k] >= first]
        links = [(T[k], np.concatenate(robot.link_parts_m[k])) for k in arm]
        points = np.concatenate([corners @ L[:3, :3].T + L[:3, 3] for L, corners in links])
        assert np.hypot(points[:, 0], points[:, 1]).max() < max(0.45 * robot.reach_m, 0.2)
        # Above the pedestal, or 30 cm above the floor.
        assert points[:, 2].min() > (0.0 if robot.base_radius_m is None else 0.3 - robot.base_height_m)
        if abs(q[first]) < 0.1:
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


def test_base_frame(robot: Robot) -> None:
    q = np.where(robot.presents == "turns", 0.0, 1.0) * robot.homes_rad[0]
    T = robot.T_base_link(q)
    np.testing.assert_allclose(T[0], robot.T_base_root, atol=1e-12)
    if robot.base_radius_m is None:
        assert T[0, 2, 3] == pytest.approx(0.0, abs=1e-9)
        return
    body = int(np.flatnonzero(robot.is_base)[-1])
    points = np.concatenate(robot.link_parts_m[body]) @ T[body, :3, :3].T + T[body, :3, 3]
    # It stands on the floor, with wheels that may have no collision shape.
    assert points[:, 2].min() == pytest.approx(-robot.base_height_m, abs=0.06)
    low = points[points[:, 2] < 0.1 - robot.base_height_m][:, :2].astype(np.float64)
    footprint = np.array(robot.base.footprint_m)
    assert inside_polygon(np.zeros((1, 2)), footprint)[0]
    assert inside_polygon(0.97 * low, footprint).all()
    assert np.hypot(*footprint.T).max() <= robot.base_radius_m + 1e-9


def test_gripper_agrees_with_the_links(robot: Robot) -> None:
    gripper = robot.gripper
    q = robot.homes_rad[0]
    T, tcp = robot.T_base_link(q), robot.T_base_tcp(q)
    hand = gripper.parts_at(gripper.max_opening_m)
    rows = range(robot.first_hand_link, len(robot.link_names))
    of_links = [part @ T[k, :3, :3].T + T[k, :3, 3] for k in rows for part in robot.link_parts_m[k]]
    ours = np.concatenate([part @ tcp[:3, :3].T + tcp[:3, 3] for part in hand])
    theirs = np.concatenate(of_links)
    assert ours.shape == theirs.shape
    for k in range(3):
        np.testing.assert_allclose(np.sort(ours[:, k]), np.sort(theirs[:, k]), atol=2e-6)
    left, right = (np.concatenate(parts) for parts in gripper.finger_parts_m)
    if gripper.linkage is not None:
        return
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
    hand = range(robot.first_hand_link, len(names))
    assert not any(a in hand and b in hand for a, b in robot.self_pairs)
    joint = robot.tree.frame_joint
    assert not any(joint[b] - joint[a] <= 1 for a, b in robot.self_pairs)
    if not robot.source.keys.base.pedestal:
        assert len(robot.self_pairs) > 20
        return
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
    palm = robot.first_hand_link
    fingers = robot.link_parts_m[palm + 1 :]
    parts = [*robot.link_parts_m[: palm + 1], *((np.concatenate(p),) for p in fingers)]
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


def test_no_collision_shape_of_the_urdf_is_lost(robot: Robot) -> None:
    """Every shape below the arm's base is a part of a body, but for those of a replaced hand."""
    tree, hand = read_trees(robot.source)
    keys = robot.source.keys

    def shapes(of: Any, link: str) -> int:
        cuts = len(keys.arm.cuts_m.get(link, ()))
        own = sum(1 + (cuts if shape.mesh else 0) for shape in of.link(link).collisions)
        return own + sum(shapes(of, joint.child) for joint in of.children(link))

    wanted = shapes(tree, keys.arm.base)
    if hand is not tree:
        wanted += shapes(hand, keys.hand.palm)
    extra = (robot.base.deck_m is not None) + (robot.reach_m < 0.5)  # a deck; the scaled family's tube
    assert sum(map(len, robot.link_parts_m)) == wanted + extra


def test_the_tree_is_where_pinocchio_puts_the_links_of_the_urdf(robot: Robot) -> None:
    """pinocchio's own reading of the file, every joint set by name; scaled arms have no such file."""
    if robot.scale != 1.0 or robot.source.keys.scaled:
        return
    import pinocchio

    pin: Any = pinocchio
    tree, _ = read_trees(robot.source)
    model = pin.buildModelFromUrdf(str(tree.path))
    data, arm, keys = model.createData(), robot.assembly.arm, robot.source.keys
    root = int(arm[0].name == TURN)
    for q in random_q(robot, 30, seed=5):
        if root:
            q[0] = 0.0
        positions = dict(zip((joint.name for joint in arm), robot.coordinates(q), strict=True))
        configuration = pin.neutral(model)
        for name in model.names[1:]:
            joint = model.joints[model.getJointId(name)]
            value = positions.get(name, position_of(tree, tree.joint(name), keys.arm.held))
            values = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
            configuration[joint.idx_q : joint.idx_q + joint.nq] = values
        pin.framesForwardKinematics(model, data, configuration)

        def place(link: str) -> np.ndarray:
            return data.oMf[model.getFrameId(link)].homogeneous

        ours = frame_poses(robot.tree, q[None])[0]
        np.testing.assert_allclose(ours[:-1], robot.T_base_link(q), atol=1e-9)
        T_root = inverse(place(keys.arm.base))
        for k in range(root + 1, robot.first_hand_link):
            seen = inverse(ours[root]) @ ours[k]
            np.testing.assert_allclose(seen, T_root @ place(arm[k - 1].child.removesuffix("-tip")), atol=1e-6)


def test_ik_solves_most_poses_from_random_seeds(robot: Robot) -> None:
    q, seeds = random_q(robot, 100), random_q(robot, 800, seed=1).reshape(100, 8, -1)
    found = [
        any(robot.ik(robot.T_base_tcp(x), s) is not None for s in near)
        for x, near in zip(q, seeds, strict=True)
    ]
    assert np.mean(found) > 0.9


def test_the_hand_closes_on_a_box_of_each_width(robot: Robot) -> None:
    """The fingers clear a box a little narrower than the opening, and both touch one a little wider."""
    gripper = robot.gripper
    least_m = 0.0 if gripper.linkage is None else float(gripper.linkage.opening_m[0])
    openings = np.linspace(max(least_m, 0.005), gripper.max_opening_m - 0.002, 7)
    depths = gripper.pad_depth_m(openings)
    assert np.abs(np.diff(depths)).max() < 0.02
    poses = gripper.body_poses(openings)
    known = gripper.linkage
    bodies = (gripper.palm_parts_m, *gripper.finger_parts_m) if known is None else known.parts_m
    side = [0, 1, -1] if known is None else known.side
    shapes = [[polyhedron(part) for part in parts] for parts in bodies]
    for width, depth, T in zip(openings, depths, poses, strict=True):
        for margin in (-0.002, 0.002):
            size = np.array([gripper.pad_size_m[0], width + margin, gripper.pad_size_m[1]])
            corners = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5
            box = polyhedron(corners * size)
            touched = {
                int(side[b])
                for b, body in enumerate(shapes)
                for shape in body
                if collides(shape, T[b], box, (0.0, 0.0, depth))
            }
            assert touched - {0} == ({1, -1} if margin > 0 else set()), (width, margin)


def collides(shape: Any, T: np.ndarray, box: Any, centre_m: tuple[float, float, float]) -> bool:
    import coal

    here: Any = coal
    result = here.CollisionResult()
    placed = here.Transform3s(np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy())
    there = here.Transform3s(np.eye(3), np.array(centre_m))
    return bool(here.collide(shape, placed, box, there, here.CollisionRequest(), result))
