"""Drops: on the surface, disjoint, clear of what stands there."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.specification import PLACE_KINDS, Places, SceneParams
from datagen.workers.scenes.placement import (
    SceneRejected,
    Standing,
    draw_place,
    drop_poses,
    eligible_surfaces,
    nearby_parts,
    standing_parts,
)
from tests.workers.worlds import ROOM_M, TABLE_TOP_M, box_body, box_model, cylinder_model, table_house

MODELS = [
    box_model("target", (0.07, 0.05, 0.2)),
    box_model("a", (0.2, 0.06, 0.1)),
    cylinder_model("b", 0.04, 0.12),
    cylinder_model("c", 0.05, 0.05),
    box_model("d", (0.3, 0.03, 0.03)),
    box_model("e", (0.06, 0.06, 0.06)),
    box_model("f", (0.15, 0.15, 0.04)),
]
PARAMS = SceneParams()


def corners(model, T: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    x, y, _ = np.array(model.size_m) / 2
    local = np.array([[-x, -y, 0, 1], [x, -y, 0, 1], [x, y, 0, 1], [-x, y, 0, 1]])
    return (local @ T.T)[:, :2]


@given(st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_drops_are_on_the_table_above_it_and_disjoint(seed: int) -> None:
    house = table_house()
    surface = house.surfaces[0]
    _, poses = drop_poses(MODELS, surface, [], PARAMS, np.random.default_rng(seed))
    low = np.array([ROOM_M[0] / 2 - 0.6, ROOM_M[1] / 2 - 0.4])
    outlines = [corners(m, T) for m, T in zip(MODELS, poses, strict=True)]
    for model, T, outline in zip(MODELS, poses, outlines, strict=True):
        assert T[2, 3] - model.size_m[2] / 2 == pytest.approx(TABLE_TOP_M + PARAMS.drop_height_m)
        assert (outline >= low).all() and (outline <= low + [1.2, 0.8]).all()
    for first, other in combinations(outlines, 2):
        axes = np.concatenate([np.diff(first[:3], axis=0), np.diff(other[:3], axis=0)])
        a, b = first @ axes.T, other @ axes.T
        assert ((a.max(0) <= b.min(0)) | (b.max(0) <= a.min(0))).any()  # a line separates them


def test_most_clutter_is_near_the_target() -> None:
    surface = table_house().surfaces[0]
    drawn = [drop_poses(MODELS, surface, [], PARAMS, np.random.default_rng(seed))[1] for seed in range(30)]
    gaps_m = np.array([np.linalg.norm(poses[1:, :2, 3] - poses[0, :2, 3], axis=1) for poses in drawn])
    assert np.mean(gaps_m <= 2 * PARAMS.clutter_radius_m) > 0.9
    assert np.mean(gaps_m <= PARAMS.clutter_radius_m) > 0.5


def test_drops_avoid_objects_on_the_surface() -> None:
    vase = box_body("vase", "small", "Vase", (0.5, 0.8, 0.3), (ROOM_M[0] / 2 + 0.3, ROOM_M[1] / 2, 0.9))
    lamp = box_body("lamp", "furniture", "Lamp", (1.0, 1.0, 0.1), (ROOM_M[0] / 2, ROOM_M[1] / 2, 2.2))
    house = table_house([vase, lamp])
    taken = standing_parts(house, house.surfaces[0])
    assert len(taken) == 1  # the vase, and neither the lamp above nor the table itself
    small = [m for m in MODELS if m.name in ("target", "b", "e")]
    for seed in range(20):
        _, poses = drop_poses(small, house.surfaces[0], taken, PARAMS, np.random.default_rng(seed))
        reach = [np.abs(corners(m, T)[:, 0]).max() for m, T in zip(small, poses, strict=True)]
        assert max(reach) <= ROOM_M[0] / 2 + 0.05 + 1e-6


def test_surfaces_are_chosen_by_height_and_a_full_one_is_a_redraw_with_its_cause() -> None:
    house = table_house()
    cover = [Standing(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64), 0.0)]
    with pytest.raises(SceneRejected) as caught:
        drop_poses(MODELS, house.surfaces[0], cover, PARAMS, np.random.default_rng(0))
    assert caught.value.cause == "no_placement"
    assert len(eligible_surfaces(house, PARAMS)) == 1
    too_low = SceneParams.model_validate({"support_height_m": {"low": 0.8, "high": 1.2}})
    assert eligible_surfaces(house, too_low) == []


def test_only_parts_around_the_support_go_into_the_physics() -> None:
    far = box_body("far", "furniture", "Sofa", (0.2, 0.2, 0.5), (0.2, 0.2, 0.25))
    near = box_body("near", "furniture", "Chair", (0.2, 0.2, 0.5), (1.2, 1.5, 0.25))
    house = table_house([far, near])
    parts = nearby_parts(house, house.surfaces[0], 0.3)
    assert any(p is near.convex_parts_m[0] for p in parts)
    assert not any(p is far.convex_parts_m[0] for p in parts)
    assert sum(p is q for p in parts for q in house.bodies[5].convex_parts_m) == 5  # table top and legs


def test_below_a_board_stand_objects_that_are_low_enough_and_clutter_without_room_is_left_out() -> None:
    params = SceneParams(places=Places(shelf=1.0))
    whole = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
    board = [Standing(whole, 0.15)]  # MODELS[0] is 0.2 m tall
    surface = table_house().surfaces[0]
    with pytest.raises(SceneRejected):
        drop_poses(MODELS, surface, board, params, np.random.default_rng(0))
    kept, poses = drop_poses(MODELS[::-1], surface, board, params, np.random.default_rng(0))
    assert kept == [0, 1, 2, 3, 4, 5] and len(poses) == 6  # the tall one, last, is left out


def test_the_floor_ends_at_the_walls_of_the_room() -> None:
    params, surface = SceneParams(places=Places(floor=1.0)), table_house().surfaces[0]
    cx, cy = ROOM_M[0] / 2, ROOM_M[1] / 2
    room_m = np.array([[cx - 0.5, cy - 0.4], [cx, cy - 0.4], [cx, cy + 0.4], [cx - 0.5, cy + 0.4]])
    small = [m for m in MODELS if m.name in ("target", "b", "e")]
    for seed in range(10):
        kept, poses = drop_poses(small, surface, [], params, np.random.default_rng(seed), room_m)
        for k, T in zip(kept, poses, strict=True):
            outline = corners(small[k], T)
            assert (outline >= room_m.min(0) - 1e-9).all() and (outline <= room_m.max(0) + 1e-9).all()


def test_targets_stand_at_the_back_and_near_the_ends_more_often_than_by_chance() -> None:
    surface, params = table_house().surfaces[0], SceneParams(places=Places(top=1.0))
    half = np.array(surface.size_m) / 2
    drawn = [drop_poses(MODELS[:1], surface, [], params, np.random.default_rng(k))[1] for k in range(200)]
    at = (np.array([T[0, :2, 3] for T in drawn]) - surface.T_world_surface[:2, 3]) / half
    assert np.mean(at[:, 1] < 0) > 0.6  # y points to the front
    assert np.mean(np.abs(at[:, 0]) > 0.5) > 0.5


def test_places_are_drawn_by_their_weights_and_none_without_weight() -> None:
    params = SceneParams(places=Places(shelf=3.0, sink=1.0), decisive=0.25)
    drawn = [draw_place(params, np.random.default_rng(k)) for k in range(400)]
    kinds = [kind for kind, _ in drawn]
    assert set(kinds) == {"shelf", "sink"}
    assert 0.65 < kinds.count("shelf") / 400 < 0.85
    assert 0.15 < np.mean([wanted for _, wanted in drawn]) < 0.35
    assert draw_place(SceneParams(), np.random.default_rng(0)) == ("top", False)
    for kind in PLACE_KINDS:
        only = SceneParams(places=Places(**{kind: 0.5}))
        assert {draw_place(only, np.random.default_rng(k))[0] for k in range(5)} == {kind}
