"""Settling by each engine: known resting places, the same from all; mass properties of convex parts."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.schemas.specification import SettleParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import pose, translation
from datagen.workers.objects.model import ObjectModel
from datagen.workers.scenes.generate import check_settled
from datagen.workers.scenes.placement import SceneRejected
from datagen.workers.settling import SETTLERS, SettleResult, load_settler
from datagen.workers.settling.pybullet_settler import MassProperties, mass_properties
from tests.workers.worlds import (
    TABLE_TOP_M,
    ball_model,
    box_mesh,
    box_model,
    box_vertices,
    cylinder_model,
    model_of,
    on_table,
    table_house,
)

PARAMS = SettleParams()
HOUSE = table_house()
PARTS = [part for body in HOUSE.bodies for part in body.convex_parts_m]

Settle = Callable[..., SettleResult]


def settler_of(name: str) -> Settle:
    """The engine, with the table's parts and parameters that are given by name."""

    def settle(
        models: list[ObjectModel], poses: list[F64], parts: list[F32] = PARTS, **params: object
    ) -> SettleResult:
        T = np.reshape(poses, (-1, 4, 4))
        return load_settler(name)(parts, models, T, PARAMS.model_copy(update=params))

    return settle


def needs(name: str) -> None:
    pytest.importorskip(name, reason="cannot be imported here: run `datagen doctor`", exc_type=ImportError)


# Largest error of a height at rest, and largest penetration, in metres.
AT_REST_M = {"pybullet": 1e-4, "sapien": 1e-3}


@pytest.fixture(params=sorted(SETTLERS))
def settle(request: pytest.FixtureRequest) -> Settle:
    needs(request.param)
    return settler_of(request.param)


def three_objects() -> tuple[list[ObjectModel], list[F64]]:
    models = [box_model("box", (0.1, 0.06, 0.2)), cylinder_model("can", 0.04, 0.1), ball_model("ball", 0.04)]
    return models, [on_table(m, dx, 0.0, 0.01) for m, dx in zip(models, (-0.3, 0.0, 0.3), strict=True)]


def bent() -> ObjectModel:
    """An L whose centre of mass is off its origin and whose principal axes are tilted."""
    foot, back = (
        box_vertices((0.12, 0.05, 0.03), (0, 0, -0.035)),
        box_vertices((0.03, 0.05, 0.07), (-0.045, 0, 0.015)),
    )
    return model_of("bent", box_mesh((0.12, 0.05, 0.1)), [foot, back], 0.4)


def cause_of(result: SettleResult, models: list[ObjectModel]) -> str:
    with pytest.raises(SceneRejected) as caught:
        check_settled(result, tuple(models), HOUSE.surfaces[0], PARAMS)
    return caught.value.cause


@pytest.mark.parametrize("name", sorted(SETTLERS))
def test_things_rest_at_half_their_height_without_a_margin(name: str) -> None:
    needs(name)
    models, poses = three_objects()
    result = settler_of(name)(models[:2], poses[:2])
    assert result.at_rest and result.steps < 500
    rest = result.T_world_object[:, 2, 3] - [m.size_m[2] / 2 for m in models[:2]]
    np.testing.assert_allclose(rest, TABLE_TOP_M, atol=AT_REST_M[name])
    assert result.penetration_m < AT_REST_M[name]
    check_settled(result, tuple(models[:2]), HOUSE.surfaces[0], PARAMS)


def test_engines_agree_on_resting_places() -> None:
    results = []
    for name in ("pybullet", "sapien"):
        needs(name)
        models, poses = three_objects()
        models.append(bent())
        results.append(settler_of(name)(models, [*poses, on_table(models[-1], 0.0, 0.25, 0.01)]))
    ours, theirs = results
    assert ours.at_rest and theirs.at_rest
    gap_m = ours.T_world_object[:, :3, 3] - theirs.T_world_object[:, :3, 3]
    assert np.abs(gap_m).max() < 2e-3
    upright = [0, 1, 3]  # a ball may roll onto another facet
    np.testing.assert_allclose(ours.T_world_object[upright], theirs.T_world_object[upright], atol=0.02)


def test_an_object_that_moves_after_the_last_step_is_not_at_rest(settle: Settle) -> None:
    ball = ball_model("ball", 0.04)
    result = settle([ball], [on_table(ball, 0, 0, 0.5)], max_steps=22)
    assert result.steps == 22 and cause_of(result, [ball]) == "not_at_rest"
    assert result.residual_speed_mps == pytest.approx(9.81 * 22 * PARAMS.timestep_s, rel=1e-3)
    fallen_m = 0.5 * 9.81 * (22 * PARAMS.timestep_s) ** 2
    assert on_table(ball, 0, 0, 0.5)[2, 3] - result.T_world_object[0, 2, 3] == pytest.approx(
        fallen_m, rel=0.06
    )
    assert result.penetration_m == 0


def test_results_that_are_no_scene_are_named(settle: Settle) -> None:
    box = box_model("box", (0.1, 0.1, 0.1))
    assert cause_of(settle([box], [on_table(box, 0.68, 0.0, 0.01)]), [box]) == "fell_off"
    good = settle([box], [on_table(box, 0, 0, 0.005)])
    deep = SettleResult(good.T_world_object, 10, True, 0.0, 0.02)
    assert cause_of(deep, [box]) == "penetration"
    broken = SettleResult(good.T_world_object * np.nan, 10, False, np.nan, 0.0)
    assert cause_of(broken, [box]) == "not_finite"


def _poses_in_a_new_process(queue: multiprocessing.Queue) -> None:  # type: ignore[type-arg]
    queue.put(settler_of("sapien")(*three_objects()).T_world_object)


def test_two_processes_agree_bit_for_bit() -> None:
    needs("sapien")
    settle, context = settler_of("sapien"), multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_poses_in_a_new_process, args=(queue,))
    process.start()
    other = queue.get(timeout=600)
    process.join()
    models, poses = three_objects()
    settle(models[::-1], poses[::-1])  # earlier calls change nothing
    np.testing.assert_array_equal(settle(models, poses).T_world_object, other)


def test_eighty_parts_are_one_body(settle: Settle) -> None:
    # Steps of a ring; only if all parts count does it lie flat.
    angles = 2 * np.pi * np.arange(80) / 80
    parts = [box_vertices((0.01, 0.01, 0.02), (0.1 * np.cos(a), 0.1 * np.sin(a), 0.0)) for a in angles]
    ring = model_of("ring", box_mesh((0.21, 0.21, 0.02)), parts, 0.2)
    inside = box_model("inside", (0.03, 0.03, 0.03))
    nested = settle([ring, inside], [on_table(ring, 0, 0, 0.002), on_table(inside, 0, 0, 0.002)])
    np.testing.assert_allclose(nested.T_world_object, [on_table(ring), on_table(inside)], atol=1e-3)


@pytest.mark.parametrize(("slope_deg", "holds"), [(27.0, True), (35.0, False)])
def test_the_friction_of_a_pair_is_the_one_asked_for(settle: Settle, slope_deg: float, holds: bool) -> None:
    # 0.6 is the tangent of 31 degrees.
    angle = np.radians(slope_deg)
    tilt = np.eye(4)
    tilt[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    ramp = (box_vertices((2, 1, 0.1), (0, 0, -0.05)) @ tilt[:3, :3].T).astype(np.float32)
    plate = box_model("plate", (0.1, 0.1, 0.02))
    result = settle([plate], [tilt @ translation(0, 0, 0.011)], [ramp], max_steps=240)
    assert (np.linalg.norm(result.T_world_object[0, :3, 3]) < 0.02) == holds


def test_penetration_is_the_depth_of_the_deepest_contact(settle: Settle) -> None:
    # A box wedged between walls that are 8 mm too close: shared by both sides, or all on one, and tilt.
    box = box_model("box", (0.1, 0.1, 0.1))
    walls = [box_vertices((0.1, 1, 1), (sign * 0.096, 0, 0.5)) for sign in (-1, 1)]
    floor = box_vertices((1, 1, 0.1), (0, 0, -0.05))
    result = settle([box], [translation(0, 0, 0.05)], [floor, *walls], max_steps=100)
    assert 0.0035 < result.penetration_m < 0.012


def test_every_world_of_bullet_is_closed_also_after_an_error() -> None:
    needs("pybullet")
    import pybullet

    first = pybullet.connect(pybullet.DIRECT)
    pybullet.disconnect(physicsClientId=first)
    settle = settler_of("pybullet")
    flat = model_of("flat", box_mesh((0.1, 0.1, 0.01)), [box_vertices((0.1, 0.1, 0.0))], 0.1)
    with pytest.raises(InputError, match="flat: convex_parts_m"):
        settle([flat], [on_table(flat)])
    settle([], [], [])
    assert not pybullet.isConnected(physicsClientId=first)  # numbers are given from the lowest free one


def tensor(properties: MassProperties) -> F64:
    R = properties.R_body_principal
    return R @ np.diag(properties.inertia_kgm2) @ R.T


@settings(max_examples=30, deadline=None)
@given(st.tuples(*[st.floats(0.02, 0.4)] * 3), st.floats(0.01, 5), st.integers(0, 2**32 - 1))
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
    split, whole = (mass_properties("b", p, 2.0) for p in (halves, [box_vertices((0.2, 0.2, 0.3))]))
    np.testing.assert_allclose(split.centre_m, whole.centre_m, atol=1e-9)
    np.testing.assert_allclose(tensor(split), tensor(whole), rtol=1e-6, atol=1e-9)


def test_a_part_without_volume_is_refused_by_name() -> None:
    flat = box_vertices((0.1, 0.1, 0.0))
    with pytest.raises(InputError, match=r"plate: convex_parts_m\[1\]: has no volume"):
        mass_properties("plate", [box_vertices((0.1, 0.1, 0.1)), flat], 1.0)
    with pytest.raises(InputError, match="nothing: convex_parts_m"):
        mass_properties("nothing", [], 1.0)
