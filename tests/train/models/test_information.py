"""What reaches the models: one table of changes, the same answers for `paper` and for `shared`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from datagen.train.models import MODELS, Model
from tests.train.models.made_batches import REACH_M, SMALL, Tables, drawn_tables, small_model

# `paper` cannot be told where the camera is: given the same, `shared` has to do without, too.
ALIKE: dict[str, dict[str, str]] = {"paper": {}, "shared": {"camera": "unknown"}, "n2m": {}}


def shift_a_point(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    clouds.points_m[0, int((~clouds.target_mask[0]).nonzero()[0])] += torch.tensor([0.03, -0.02, 0.04])
    return clouds, candidates, robots


def swap_the_target(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    return replace(clouds, target_mask=~clouds.target_mask), candidates, robots


def paint_the_scene(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    return replace(clouds, rgb=255 - clouds.rgb), candidates, robots


def paint_the_target(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    rgb = torch.where(clouds.target_mask[..., None], 255 - clouds.rgb, clouds.rgb)
    return replace(clouds, rgb=rgb), candidates, robots


def move_the_candidates(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    return clouds, replace(candidates, base_xy_m=candidates.base_xy_m + 0.05), robots


def raise_the_mount(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    return clouds, candidates, replace(robots, base_height_m=robots.base_height_m + 0.1)


def raise_mount_and_target(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    higher = replace(robots, base_height_m=robots.base_height_m + 0.25)
    return replace(clouds, target_height_m=clouds.target_height_m + 0.25), candidates, higher


def raise_the_camera(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    return clouds, candidates, replace(robots, camera_height_m=robots.camera_height_m + 0.2)


def shorten_the_arm(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    return clouds, candidates, replace(robots, arm_reach_m=robots.arm_reach_m / 3)


def name_another_radius(tables: Tables) -> Tables:
    clouds, candidates, robots = tables
    return replace(clouds, target_radius_m=clouds.target_radius_m * 1.5), candidates, robots


def paint_what_is_out_of_reach(tables: Tables) -> Tables:
    """Stored points beyond the reach, before and between those within, take another place and colour."""
    clouds, candidates, robots = tables
    clouds.points_m[:, ::7] *= 3 * REACH_M / clouds.points_m[:, ::7].norm(dim=2, keepdim=True)
    clouds.rgb[:, ::7] = 7
    clouds.target_mask[:, ::7] = True
    return clouds, candidates, robots


def shuffle_what_comes_late(tables: Tables) -> Tables:
    """Points stored after as many within reach as the models take."""
    clouds, candidates, robots = tables
    late = torch.cat([torch.arange(96), 96 + torch.randperm(clouds.points_m.shape[1] - 96)])
    clouds = replace(
        clouds,
        points_m=clouds.points_m[:, late] + 0.0,
        rgb=clouds.rgb[:, late],
        target_mask=clouds.target_mask[:, late],
    )
    return clouds, candidates, robots


# change -> whether logits must differ, and the stored points of a cloud
CHANGES: dict[Callable[[Tables], Tables], bool] = {
    shift_a_point: True,
    swap_the_target: True,
    paint_the_scene: True,
    paint_the_target: False,  # it has its own colour
    move_the_candidates: True,
    raise_the_mount: True,
    raise_mount_and_target: False,  # heights count from the mount
    raise_the_camera: False,
    shorten_the_arm: True,
    name_another_radius: False,  # it is taken from the points
    shuffle_what_comes_late: False,
}


@pytest.fixture(scope="module", params=sorted(MODELS))
def model(request: pytest.FixtureRequest) -> Model:
    return small_model(request.param, **ALIKE[request.param])


@pytest.mark.parametrize(("change", "seen"), CHANGES.items(), ids=lambda v: getattr(v, "__name__", ""))
@torch.no_grad()
def test_both_models_see_the_same(model: Model, change: Callable[[Tables], Tables], seen: bool):
    def tables() -> Tables:
        # As many points as the models take in all but one case, where the rest must not matter.
        return drawn_tables(5, points=160 if change is shuffle_what_comes_late else 96)

    before, after = model.score(*tables()), model.score(*change(tables()))
    if seen:
        assert float((after - before).abs().amax()) > 1e-4
    else:
        torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", sorted(MODELS))
@torch.no_grad()
def test_points_out_of_reach_change_nothing(name: str):
    model = small_model(name, n_points=200)
    far = paint_what_is_out_of_reach(drawn_tables(6))
    clouds, candidates, robots = far
    elsewhere = clouds.points_m.clone()
    elsewhere[:, ::7] += 2.0 * elsewhere[:, ::7]
    moved = replace(clouds, points_m=elsewhere, rgb=clouds.rgb.index_fill(1, torch.tensor([0, 7]), 200))
    assert torch.equal(model.score(*far), model.score(moved, candidates, robots))


@torch.no_grad()
def test_a_given_camera_changes_logits():
    model = small_model("shared", camera="given")
    before, after = model.score(*drawn_tables(5)), model.score(*raise_the_camera(drawn_tables(5)))
    assert float((after - before).abs().amax()) > 1e-4


def test_small_models_use_their_number_of_points():
    assert {config["n_points"] for config in SMALL.values()} == {96}
