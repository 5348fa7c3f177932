"""The shared model: turning the scene changes nothing, and its pieces put everything in its place."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from datagen.train.models import Model
from datagen.train.models.frames import frames_of, pair_features
from datagen.train.models.hand_pooling import tiles
from tests.train.models.made_batches import drawn_tables, mirrored, small_model, turned_about_z


@pytest.fixture(scope="module")
def model() -> Model:
    """Without hand poses, whose clearances are in cells: they change a little when the scene turns."""
    return small_model("shared", width=32, embedding=32, hand_poses=0)


@settings(max_examples=25, deadline=None)
@given(angle=st.floats(-10, 10), seed=st.integers(0, 50))
@torch.no_grad()
def test_rotating_cloud_and_candidates_together_changes_nothing(model: Model, angle: float, seed: int):
    tables = drawn_tables(seed)
    turned = turned_about_z(tables, angle)
    logits = model.score(*tables)
    torch.testing.assert_close(model.score(*turned), logits, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("is_mirrored", [True, False])
@torch.no_grad()
def test_only_mirrored_models_are_invariant_to_a_mirror(is_mirrored: bool):
    model, tables = small_model("shared", mirrored=is_mirrored, hand_poses=0), drawn_tables(4)
    change = float((model.score(*mirrored(tables)) - model.score(*tables)).abs().amax())
    assert change < 1e-5 if is_mirrored else change > 1e-3


@torch.no_grad()
def test_rotating_the_candidates_alone_changes_logits(model: Model):
    clouds, candidates, robots = drawn_tables(0)
    _, elsewhere, _ = turned_about_z((clouds, candidates, robots), 1.0)
    change = model.score(clouds, elsewhere, robots) - model.score(clouds, candidates, robots)
    assert float(change.abs().amax()) > 1e-3


@torch.no_grad()
def test_training_alone_leaves_out_tokens_and_hand_poses():
    model, tables = small_model("shared", dropout=0.0, hand_poses=24), drawn_tables(3)
    scores: dict[bool, list[Tensor]] = {False: [], True: []}
    for is_training in scores:
        model.train(is_training)
        for seed in (1, 2, 1):
            torch.manual_seed(seed)
            scores[is_training].append(model.score(*tables))
    model.eval()
    (one, other, again), (first, second, repeated) = scores[False], scores[True]
    assert torch.equal(one, other) and torch.equal(one, again)
    assert torch.equal(first, repeated) and float((first - second).abs().amax()) > 1e-3


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 5), max_size=60), st.integers(1, 12))
def test_tiles_hold_every_candidate_once_with_its_robot(rows: list[int], size: int):
    robot_row = torch.tensor(rows, dtype=torch.int64)
    seen: list[int] = []
    for robots, held in tiles(robot_row, size):
        assert held.numel() <= size
        assert torch.equal(robot_row[held], robots[:, None].expand_as(held))
        seen += held.flatten().tolist()
    assert sorted(seen) == list(range(len(rows)))


def frame_at(x: float, y: float, rise: float, camera: float) -> Tensor:
    return frames_of(torch.tensor([[x, y]]), *(torch.tensor([v]) for v in (rise, camera, 0.8, 0.1)))


def test_a_point_on_the_line_of_sight_has_no_offset_from_it():
    # Target at the origin, camera 0.6 m before it and 0.3 m above: half way between them, and beside that.
    frame = frame_at(0.0, -0.6, 0.2, 0.3)
    places = torch.tensor([[[0.0, -0.3, 0.15], [-0.1, -0.3, 0.15], [0.0, 0.0, 0.0]]])
    side, height, before = pair_features(frame, places)[0, :, :3].unbind(1)
    torch.testing.assert_close(height, torch.zeros(3), atol=1e-5, rtol=0)
    # 0.1 m to the left (of +y, which is -x) half way is 0.2 m on the target: two of its radii.
    torch.testing.assert_close(side, torch.tensor([0.0, 2.0, 0.0]), atol=1e-5, rtol=0)
    half = math.hypot(0.3, 0.15) / 0.1 / 2
    torch.testing.assert_close(before, torch.tensor([half, half, 0.0]).clamp(max=3), atol=1e-5, rtol=0)


def test_distances_from_the_mount_and_from_the_arms_line():
    # The mount is 0.6 m before the target and 0.2 m below it.
    frame = frame_at(0.6, 0.0, 0.2, 0.3)
    places = torch.tensor([[[0.6, 0.0, -0.2], [0.3, 0.0, -0.1], [0.3, 0.05, -0.1], [-0.1, 0.0, 0.0]]])
    features = pair_features(frame, places)[0]
    half = math.hypot(0.3, 0.1)
    want = torch.tensor([0.0, half, math.hypot(half, 0.05), math.hypot(0.7, 0.2)]) / 0.8
    torch.testing.assert_close(features[:, 5], want, atol=1e-5, rtol=0)
    torch.testing.assert_close(features[:, 6], 3 * torch.tensor([0.0, 0.0, 0.05, 0.1]), atol=1e-5, rtol=0)


@torch.no_grad()
def test_observed_visibility_is_one_more_input():
    model = small_model("shared", observed_visibility=True)
    clouds, candidates, robots = drawn_tables(1, scenes=1, robots=1)
    before = model.score(clouds, candidates, robots)
    # A wall around the target.
    angle = torch.linspace(0, 2 * math.pi, 30)
    ring = torch.stack([0.12 * angle.cos(), 0.12 * angle.sin()], dim=1)
    levels = torch.linspace(-0.1, 0.3, 14)
    wall = torch.cat([torch.nn.functional.pad(ring, (0, 1), value=float(z)) for z in levels])
    points = torch.cat([clouds.points_m, wall[None]], dim=1)
    grown = replace(
        clouds,
        points_m=points,
        rgb=torch.zeros_like(points).byte(),
        target_mask=torch.nn.functional.pad(clouds.target_mask, (0, len(wall))),
        n_points=torch.tensor([points.shape[1]]),
    )
    hidden = model.score(grown, candidates, robots)
    assert torch.isfinite(before).all()
    # Tokens are made of the first 96 points alone, black by now: the estimate is what reads the wall.
    black = replace(clouds, rgb=torch.zeros_like(clouds.rgb))
    assert float((hidden - model.score(black, candidates, robots)).abs().amax()) > 1e-4
