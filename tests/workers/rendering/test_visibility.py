"""rho on stages whose answer is known, and against brute force."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering.embree import ray_scene
from datagen.workers.rendering.visibility import visible_pixels
from tests.independent import pixel_counts
from tests.workers.worlds import (
    ROOM_M,
    TABLE_TOP_M,
    ball_model,
    box_model,
    coloured,
    cylinder_model,
    model_of,
    stage_with,
)

CENTRE = (ROOM_M[0] / 2, ROOM_M[1] / 2)
BOX = box_model("target", (0.1, 0.1, 0.1))
_ENDS_M = (0.1 * np.concatenate([np.zeros((1, 3)), np.eye(3)]) - 0.05).astype(np.float32)
_SIDES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
# The middle of its bounding box lies outside.
CORNER = model_of("corner", coloured(_ENDS_M, _SIDES, (180, 60, 60)), (_ENDS_M,), 0.3)
BOARD = box_model("board", (0.01, 0.6, 0.6))


@pytest.mark.parametrize(
    ("boards_m", "eye_m", "share"),
    [
        ([], (0.5, 1.5, 1.2), 1),
        ([], (2.0, 1.5, 2.2), 1),
        ([], (-1.0, 1.5, 1.2), 0),  # outside, behind the wall
        ([], (2.0, 1.5, 0.3), 0),  # under the table
        ([(-0.3, 0)], (0.5, 1.5, 0.85), 0),
        ([(0.3, 0)], (0.5, 1.5, 0.85), 1),
        # The board's edge lies on the sight line's plane: it hides what is left of it.
        ([(-0.3, -0.3)], (0.3, CENTRE[1], TABLE_TOP_M + 0.05), 0.5),
    ],
)
def test_walls_boards_and_the_table_hide_what_is_behind_them(
    boards_m: list[tuple[float, float]], eye_m: tuple[float, float, float], share: float
) -> None:
    stage = stage_with([BOX, *([BOARD] * len(boards_m))], [(0, 0), *boards_m])
    alone, seen = visible_pixels(ray_scene(stage), 0, np.array([eye_m]), 64)
    assert seen[0] / alone[0] == pytest.approx(share, abs=0.03)


def test_a_ball_fills_its_window_as_a_disc_does_and_an_eye_inside_it_sees_nothing() -> None:
    stage = stage_with([ball_model("target", 0.06)], [(0, 0)])
    eyes = np.array([stage.T_world_object[0, :3, 3], [0.6, 1.5, 1.4], [2.0, 0.2, 0.9]])
    alone, seen = visible_pixels(ray_scene(stage), 0, eyes, 64)
    assert (alone[0], seen[0]) == (0, 0)
    np.testing.assert_allclose(alone[1:] / 64**2, np.pi / 4, rtol=0.03)


@given(
    st.lists(st.tuples(st.floats(-0.4, 0.4), st.floats(-0.3, 0.3)), min_size=4, max_size=4),
    st.floats(-np.pi, np.pi),
    st.floats(0.25, 1.2),
    st.floats(0.4, 1.5).filter(lambda z: abs(z - 0.75) > 0.005),  # in the table's top, rays only touch it
)
@settings(max_examples=60, deadline=None)
def test_pixel_counts_equal_those_of_a_second_implementation(
    offsets: list[tuple[float, float]], angle: float, distance: float, height: float
) -> None:
    models = [
        cylinder_model("target", 0.03, 0.15),
        box_model("a", (0.1, 0.05, 0.2)),
        ball_model("b", 0.05),
        box_model("c", (0.04, 0.3, 0.04)),
    ]
    stage = stage_with(models, offsets)
    placed = [m.visual.transformed(T) for m, T in zip(models, stage.T_world_object, strict=True)]
    meshes = [*placed, *(b.visual for b in stage.house.bodies)]
    triangles = [m.vertices_m.astype(np.float64)[m.faces] for m in meshes]
    xy = np.array(CENTRE) + distance * np.array([np.cos(angle), np.sin(angle)])
    eye = np.array([*np.clip(xy, 0.05, np.array(ROOM_M) - 0.05), height])
    centre = stage.T_world_object[0, :3, 3]
    expected = pixel_counts(triangles[0], np.concatenate(triangles[1:]), centre, models[0].radius_m, eye, 48)
    alone, seen = visible_pixels(ray_scene(stage), 0, eye[None], 48)
    # A pixel centre that falls on an edge may round either way.
    assert alone[0] == pytest.approx(expected[0], abs=3)
    assert seen[0] == pytest.approx(expected[1], abs=6)


def test_blocks_of_rays_do_not_change_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = ray_scene(
        stage_with([ball_model("t", 0.05), box_model("a", (0.1, 0.1, 0.2))], [(0, 0), (0.15, 0)])
    )
    eyes = np.random.default_rng(1).uniform((0.2, 0.2, 0.8), (3.8, 2.8, 1.5), (50, 3))
    whole = visible_pixels(stage, 0, eyes, 32)
    monkeypatch.setattr("datagen.workers.rendering.visibility._MAX_RAYS", 32 * 32 * 7)
    np.testing.assert_array_equal(whole, visible_pixels(stage, 0, eyes, 32))


@pytest.mark.parametrize(
    "model",
    [
        BOX,
        ball_model("ball", 0.06),
        cylinder_model("long", 0.004, 0.3),
        box_model("sheet", (0.2, 0.1, 0.0)),
        CORNER,
    ],
    ids=lambda model: model.name,
)
def test_pixels_left_out_around_the_target_change_no_count(model: ObjectModel) -> None:
    stage = ray_scene(stage_with([model], [(0, 0)]))
    target = stage.objects[0]
    axes = np.random.default_rng(2).normal(size=(500, 3))
    assert ((target.mesh.vertices_m @ axes.T).max(0) <= (target.around_m @ axes.T).max(0)).all()
    eyes = np.random.default_rng(3).uniform((1.2, 0.7, 0.0), (2.8, 2.3, 1.5), (60, 3))
    few = visible_pixels(stage, 0, eyes, 64)
    target.__dict__["around_m"] = np.array(list(product((-9.0, 9.0), repeat=3)))  # the whole window
    np.testing.assert_array_equal(few, visible_pixels(stage, 0, eyes, 64))
    assert few[0].any()
