"""Kinematics of any tree against pinocchio; solutions against their limits and goals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.inverse import (
    ANGLE_TOLERANCE_RAD,
    POSITION_TOLERANCE_M,
    TreePoses,
    ik_workspace,
    joint_poses,
    pose_error,
    solve,
    tcp_jacobian,
    tcp_pose,
)
from datagen.workers.kinematics.tree import Coordinates, KinematicTree, frame_poses
from tests.workers.kinematics.trees import random_coordinates, random_pose, random_tree
from tests.workers.oracles import TreeOracle, off_goal, pin, se3
from tests.workers.robots.robots_under_test import CASES, Case, opened

SEEDS = st.integers(0, 2**32 - 1)


def check_kinematics(tree: KinematicTree, rng: np.random.Generator) -> None:
    """Poses, their Jacobian and coordinates of joints at some coordinates, seen from a root that is moved."""
    oracle, turned, root = TreeOracle(tree), tree.along_z(), random_pose(rng)
    poses, compiled, q = TreePoses(tree), in_memory(turned), random_coordinates(tree, rng)
    frames = oracle.frames(q)
    np.testing.assert_allclose(poses(q), frames[:, :3], atol=1e-9)
    np.testing.assert_allclose(frame_poses(tree, q[None])[0], frames, atol=1e-9)
    np.testing.assert_allclose(frame_poses(turned, q[None], tcp_only=True)[0, 0], frames[-1], atol=1e-9)
    np.testing.assert_array_equal(turned.axis, np.tile([0.0, 0.0, 1.0], (len(tree.axis), 1)))
    joints, tcp, jacobian = np.empty((len(tree.parent), 3, 4)), np.empty((3, 4)), np.empty((len(q), 6))
    joint_poses(compiled, np.ascontiguousarray(root[:3]), q, joints)
    tcp_pose(compiled, np.ascontiguousarray(root[:3]), joints, tcp)
    np.testing.assert_allclose(tcp, (root @ frames[-1])[:3], atol=1e-9)
    tcp_jacobian(compiled, joints, tcp, jacobian)
    np.testing.assert_allclose(jacobian, oracle.tcp_jacobian(q), atol=1e-7)
    of = Coordinates.of(tree)
    np.testing.assert_allclose(of(q), tree.ratio * q[tree.coordinate] + tree.offset, atol=1e-12)


@settings(max_examples=150)
@given(SEEDS)
def test_any_tree_moves_as_in_pinocchio(seed: int) -> None:
    rng = np.random.default_rng(seed)
    check_kinematics(random_tree(rng), rng)


@pytest.mark.parametrize("case", CASES)
def test_every_robot_moves_as_in_pinocchio(case: Case) -> None:
    robot = opened(case)
    rng = np.random.default_rng(1)
    for _ in range(10):
        check_kinematics(robot.tree, rng)
    oracle, q = TreeOracle(robot.tree), random_coordinates(robot.tree, rng)
    np.testing.assert_allclose(robot.T_base_link(q), oracle.frames(q)[:-1], atol=1e-9)
    np.testing.assert_allclose(robot.T_base_tcp(q), oracle.frames(q)[-1], atol=1e-9)


@settings(max_examples=200)
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 1.0, np.pi - 1e-5, np.pi - 1e-9, np.pi]))
def test_the_pose_error_is_the_logarithm(seed: int, angle_rad: float) -> None:
    rng = np.random.default_rng(seed)
    T, axis = random_pose(rng), np.concatenate([np.eye(3), rng.normal(size=(4, 3))])[rng.integers(7)]
    turn = pin.SE3(pin.exp3(angle_rad * axis / np.linalg.norm(axis)), rng.normal(size=3))
    goal, error = (se3(T) * turn).homogeneous, np.empty(6)
    pose_error(np.ascontiguousarray(T[:3]), np.ascontiguousarray(goal[:3]), error, np.empty((5, 3)))
    np.testing.assert_allclose(pin.exp6(error).homogeneous, turn.homogeneous, atol=1e-6)
    assert np.linalg.norm(error[3:]) <= np.pi + 1e-9
    if angle_rad < 3:  # beyond, the axis may be turned round
        np.testing.assert_allclose(error, pin.log6(turn).vector, atol=1e-9)


def solved(tree: KinematicTree, root: F64, goal: F64, q: F64) -> bool:
    compiled = in_memory(tree.along_z())
    return solve(compiled, *(np.ascontiguousarray(T[:3]) for T in (root, goal)), q, ik_workspace(compiled))


@settings(max_examples=150)
@given(SEEDS)
def test_solutions_reach_their_goals_within_the_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree, root = random_tree(rng), random_pose(rng)
    oracle, there, q = TreeOracle(tree), random_coordinates(tree, rng), random_coordinates(tree, rng)
    goal = root @ oracle.frames(there)[-1]
    if solved(tree, root, goal, q):
        off_m, off_rad = off_goal(root @ oracle.frames(q)[-1], goal)
        assert off_m < POSITION_TOLERANCE_M + 1e-9 and off_rad < ANGLE_TOLERANCE_RAD + 1e-9
    # A failure leaves the coordinates within the limits too, and seeds outside of them are moved there.
    assert ((q >= tree.lower) & (q <= tree.upper)).all()
    same = there.copy()
    assert solved(tree, root, goal, same)
    np.testing.assert_array_equal(same, there)
    outside = np.where(rng.random(len(there)) < 0.5, tree.lower - 1.0, there)
    solved(tree, root, goal, outside)
    assert ((outside >= tree.lower) & (outside <= tree.upper)).all()
    goal[:3, 3] += 1e3
    assert not solved(tree, root, goal, q)


@settings(max_examples=60)
@given(SEEDS)
def test_goals_near_the_seed_are_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng)
    there = random_coordinates(tree, rng)
    q = np.clip(there + rng.normal(0.0, 0.02, len(there)), tree.lower, tree.upper)
    assert solved(tree, np.eye(4), TreeOracle(tree).frames(there)[-1], q)
