"""Mass properties of convex parts against bodies whose integrals are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import pose
from datagen.workers.settling.pybullet_settler import MassProperties, mass_properties
from tests.workers.worlds import ball_model, box_vertices, cylinder_model

edge = st.floats(0.02, 0.4)


def tensor(properties: MassProperties) -> F64:
    R = properties.R_body_principal
    return R @ np.diag(properties.inertia_kgm2) @ R.T


@settings(max_examples=30, deadline=None)
@given(st.tuples(edge, edge, edge), st.floats(0.01, 5), st.integers(0, 2**32 - 1))
def test_a_box_anywhere_has_the_inertia_of_the_formula(
    size_m: tuple[float, float, float], mass_kg: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    T = pose(rng.uniform(-1, 1, 3), rng.standard_normal(4))
    corners = (box_vertices(size_m) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    found = mass_properties("box", [corners], mass_kg)
    np.testing.assert_allclose(found.centre_m, T[:3, 3], atol=1e-6)
    square = np.square(size_m)
    own = mass_kg / 12 * np.diag(square.sum() - square)
    np.testing.assert_allclose(tensor(found), T[:3, :3] @ own @ T[:3, :3].T, atol=1e-4 * own.max())
    assert np.linalg.det(found.R_body_principal) == pytest.approx(1)


def test_a_cylinder_and_a_ball_come_near_the_round_formulas() -> None:
    can = cylinder_model("can", 0.04, 0.12, mass_kg=0.4, sides=128)
    found = mass_properties("can", can.convex_parts_m, 0.4)
    across = 0.4 * (3 * 0.04**2 + 0.12**2) / 12
    np.testing.assert_allclose(np.diag(tensor(found)), [across, across, 0.4 * 0.04**2 / 2], rtol=2e-3)
    ball = ball_model("ball", 0.05)
    # The facets lie inside the sphere, so a little below 2/5 m r^2.
    inertia = mass_properties("ball", ball.convex_parts_m, 1.0).inertia_kgm2 / (0.4 * 0.05**2)
    assert (inertia > 0.95).all() and (inertia < 1).all()


def test_parts_add_up_to_the_box_that_they_fill() -> None:
    halves = [box_vertices((0.1, 0.2, 0.3), (sign * 0.05, 0, 0)) for sign in (-1, 1)]
    split, whole = (
        mass_properties("h", halves, 2.0),
        mass_properties("w", [box_vertices((0.2, 0.2, 0.3))], 2.0),
    )
    np.testing.assert_allclose(split.centre_m, whole.centre_m, atol=1e-9)
    np.testing.assert_allclose(tensor(split), tensor(whole), rtol=1e-6, atol=1e-9)


def test_a_part_without_volume_is_refused_by_name() -> None:
    flat = box_vertices((0.1, 0.1, 0.0))
    with pytest.raises(InputError, match=r"plate: convex_parts_m\[1\]: has no volume"):
        mass_properties("plate", [box_vertices((0.1, 0.1, 0.1)), flat], 1.0)
    with pytest.raises(InputError, match="nothing: convex_parts_m"):
        mass_properties("nothing", [], 1.0)
