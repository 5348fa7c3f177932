"""Label sources `plan` and `sim`: what they share, on real scenes with a real arm."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.identity import Stream, generator
from datagen.schemas.specification import DisturbanceParams
from datagen.workers.geometry.transforms import pose
from datagen.workers.labels.arm_labelling import draw_disturbances

quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
positions = st.tuples(*[st.floats(-20, 20)] * 3)


@given(q=quaternions, position=positions, seed=st.integers(0, 2**32))
def test_a_disturbed_target_slides_and_turns_on_its_plane_however_it_lies(
    q: tuple[float, ...], position: tuple[float, ...], seed: int
) -> None:
    T = pose(np.array(position), np.array(q))
    params = DisturbanceParams(repeats=3)
    for disturbance in draw_disturbances(params, T, generator(seed, Stream.DISTURBANCE, 0)):
        moved = T @ disturbance.T_target_moved
        turn = moved[:3, :3] @ T[:3, :3].T
        np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-9)
        assert abs(moved[2, 3] - T[2, 3]) < 1e-9
        assert disturbance.T_base_moved[2, 3] == 0
        assert params.object_friction.low <= disturbance.object_friction <= params.object_friction.high
        assert params.mass_scale.low <= disturbance.mass_scale <= params.mass_scale.high


def test_disturbances_have_the_asked_spread() -> None:
    params = DisturbanceParams(repeats=1000, target_position_std_m=0.01, base_yaw_std_rad=0.02)
    drawn = draw_disturbances(params, np.eye(4), generator(0, Stream.DISTURBANCE, 0))
    x = np.array([d.T_target_moved[0, 3] for d in drawn])
    yaw = np.array([np.arctan2(d.T_base_moved[1, 0], d.T_base_moved[0, 0]) for d in drawn])
    np.testing.assert_allclose([x.std(), yaw.std()], [0.01, 0.02], rtol=0.1)
    assert abs(x.mean()) < 0.002


def test_fewer_repeats_are_the_first_of_more() -> None:
    few, many = (
        draw_disturbances(DisturbanceParams(repeats=k), np.eye(4), generator(3, Stream.DISTURBANCE, 1))
        for k in (2, 5)
    )
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.T_target_moved, b.T_target_moved)
        assert a.object_friction == b.object_friction
