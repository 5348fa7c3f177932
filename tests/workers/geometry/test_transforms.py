"""Rigid transforms: inverses, quaternions and cameras."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from datagen.workers.geometry.transforms import inverse, look_at, pose, quaternion_wxyz, rotation_of, yaw_pose

quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 1e-3)


@given(quaternions)
def test_quaternion_and_matrix_agree_with_scipy_and_with_each_other(q: tuple[float, ...]) -> None:
    R = rotation_of(np.array(q))
    np.testing.assert_allclose(R, Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation_of(quaternion_wxyz(R)), R, atol=1e-12)


@given(quaternions, st.tuples(*[st.floats(-50, 50)] * 3))
def test_inverse_undoes_a_pose(q: tuple[float, ...], p: tuple[float, ...]) -> None:
    T = pose(np.array(p), np.array(q))
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-10)


def test_yaw_turns_counter_clockwise_seen_from_above() -> None:
    np.testing.assert_allclose(yaw_pose(1, 2, 3, np.pi / 2) @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)


@pytest.mark.parametrize("eye", [(3.0, 0.0, 1.0), (-1.0, 2.0, 0.5), (0.0, 0.0, 2.0), (0.0, 0.0, -2.0)])
def test_a_camera_looks_at_its_target_and_stays_upright(eye: tuple[float, float, float]) -> None:
    T = look_at(np.array(eye), np.zeros(3))
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    seen = inverse(T) @ [0, 0, 0, 1]
    np.testing.assert_allclose(seen[:3], [0, 0, np.linalg.norm(eye)], atol=1e-12)
    assert T[2, 0] == pytest.approx(0)  # the image's horizontal stays horizontal
    assert T[2, 1] <= 1e-12  # the image's down points down


@given(st.lists(st.tuples(*[st.floats(-50, 50)] * 3).filter(lambda p: np.hypot.reduce(p) > 1e-3), min_size=1))
def test_many_cameras_are_bit_for_bit_those_of_single_calls(eyes: list[tuple[float, float, float]]) -> None:
    many = look_at(np.array(eyes), np.zeros(3))
    assert many.tobytes() == np.stack([look_at(np.array(eye), np.zeros(3)) for eye in eyes]).tobytes()
