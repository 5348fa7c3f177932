"""Settling by PhysX: known resting heights, repeatability, and results that are no scene."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")

from datagen.schemas.specification import SettleParams
from datagen.workers.objects.model import ObjectModel
from datagen.workers.scenes.generate import check_settled
from datagen.workers.scenes.placement import SceneRejected
from datagen.workers.settling import SettleResult
from datagen.workers.settling.sapien_physics import settle_sapien
from tests.workers.worlds import TABLE_TOP_M, ball_model, box_model, cylinder_model, on_table, table_house

PARAMS = SettleParams()
HOUSE = table_house()
PARTS = [p for b in HOUSE.bodies for p in b.convex_parts_m]


def settle(models: list[ObjectModel], poses: list[np.ndarray], **params: object) -> SettleResult:
    return settle_sapien(PARTS, models, np.stack(poses), PARAMS.model_copy(update=params))


def three_objects() -> tuple[list[ObjectModel], list[np.ndarray]]:
    models = [box_model("box", (0.1, 0.06, 0.2)), cylinder_model("can", 0.04, 0.1), ball_model("ball", 0.04)]
    poses = [on_table(m, dx, 0.0, 0.01) for m, dx in zip(models, (-0.3, 0.0, 0.3), strict=True)]
    return models, poses


def test_things_dropped_flat_rest_at_half_their_height() -> None:
    models, poses = three_objects()
    result = settle(models[:2], poses[:2])
    assert result.at_rest
    rest = result.T_world_object[:, 2, 3] - [m.size_m[2] / 2 for m in models[:2]]
    np.testing.assert_allclose(rest, TABLE_TOP_M, atol=1e-3)
    assert result.penetration_m < 1e-3
    assert result.steps < 500
    check_settled(result, tuple(models[:2]), HOUSE.surfaces[0], PARAMS)


def _poses_in_a_new_process(queue: multiprocessing.Queue) -> None:  # type: ignore[type-arg]
    queue.put(settle(*three_objects()).T_world_object)


def test_two_processes_agree_bit_for_bit() -> None:
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_poses_in_a_new_process, args=(queue,))
    process.start()
    other = queue.get(timeout=600)
    process.join()
    models, poses = three_objects()
    settle(models[::-1], poses[::-1])  # earlier calls change nothing
    np.testing.assert_array_equal(settle(models, poses).T_world_object, other)


def cause_of(result: SettleResult, models: list[ObjectModel]) -> str:
    with pytest.raises(SceneRejected) as caught:
        check_settled(result, tuple(models), HOUSE.surfaces[0], PARAMS)
    return caught.value.cause


def test_an_object_dropped_beside_the_table_fell_off() -> None:
    box = box_model("box", (0.1, 0.1, 0.1))
    assert cause_of(settle([box], [on_table(box, 0.68, 0.0, 0.01)]), [box]) == "fell_off"


def test_an_object_that_moves_after_the_last_step_is_not_at_rest() -> None:
    ball = ball_model("ball", 0.04)
    result = settle([ball], [on_table(ball, 0, 0, 0.5)], max_steps=20)
    assert result.steps == 20
    assert cause_of(result, [ball]) == "not_at_rest"


def test_penetration_and_nan_are_named() -> None:
    box = box_model("box", (0.1, 0.1, 0.1))
    good = settle([box], [on_table(box, 0, 0, 0.005)])
    deep = SettleResult(good.T_world_object, 10, True, 0.0, 0.02)
    assert cause_of(deep, [box]) == "penetration"
    broken = SettleResult(good.T_world_object * np.nan, 10, False, np.nan, 0.0)
    assert cause_of(broken, [box]) == "not_finite"
