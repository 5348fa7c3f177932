"""The stored cloud: a sample of the frame, cropped, in farthest-point order."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.schemas.specification import ObservationParams
from datagen.workers.rendering import cloud as module
from datagen.workers.rendering.cloud import Cloud, caster_of, farthest_points, observe_cloud, target_pixels
from datagen.workers.rendering.embree import cast_pixels, ray_scene, render_rays
from tests.workers.worlds import ball_model, box_model, camera_at, stage_with

STAGE = stage_with([box_model("target", (0.06, 0.06, 0.1)), ball_model("ball", 0.05)], [(0, 0), (0.15, 0.05)])
RAYS = ray_scene(STAGE)
CENTRE = STAGE.T_world_object[0, :3, 3]
CAMERA = camera_at((0.8, 0.9, 1.4), tuple(CENTRE), 320, 240, 300.0)
PARAMS = ObservationParams(n_points=1024, min_target_points=100, n_farthest=256)
FRAME = render_rays(RAYS, CAMERA)


def observe(params: ObservationParams = PARAMS, whole_frame: bool = False, seed: int = 0) -> Cloud:
    cast = caster_of(FRAME) if whole_frame else (lambda pixels: cast_pixels(RAYS, CAMERA, pixels))
    radius = float(RAYS.radii_m[0])
    return observe_cloud(cast, CAMERA, 1, CENTRE, radius, params, np.random.default_rng(seed))


def test_casting_only_the_drawn_pixels_gives_the_cloud_of_the_whole_frame() -> None:
    sparse, dense = observe(), observe(whole_frame=True)
    np.testing.assert_array_equal(sparse.points_m, dense.points_m)
    np.testing.assert_array_equal(sparse.rgb, dense.rgb)
    np.testing.assert_array_equal(sparse.target_mask, dense.target_mask)
    assert sparse.n == dense.n == 1024


@pytest.mark.parametrize("block", [2, 7, 300])
def test_pixels_around_the_target_may_be_cast_in_blocks(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    at_once = observe()
    monkeypatch.setattr(module, "_WINDOW_BLOCK", block)
    for name, values in vars(observe()).items():
        np.testing.assert_array_equal(values, vars(at_once)[name])


def test_points_lie_on_the_scene_within_the_crop() -> None:
    cloud = observe()
    points = cloud.points_m.astype(np.float64)
    assert np.linalg.norm(points, axis=1).max() <= 1.0 + 1e-3
    on_target = points[cloud.target_mask]
    # Every target point lies on the surface of the 6 x 6 x 10 cm box around the origin.
    gap = np.abs(on_target) - np.array([0.03, 0.03, 0.05])
    assert np.abs(gap.max(axis=1)).max() < 5e-4
    assert cloud.target_mask.sum() >= 100
    assert len(np.unique(points, axis=0)) == 1024


def test_a_cloud_with_too_few_points_is_padded_with_zeros() -> None:
    cloud = observe(ObservationParams(n_points=65_536, crop_radius_m=0.1, n_farthest=64))
    assert 0 < cloud.n < 65_536
    assert not cloud.points_m[cloud.n :].any()
    assert not cloud.target_mask[cloud.n :].any()
    window = target_pixels(CAMERA, CENTRE, float(RAYS.radii_m[0]))
    assert (FRAME.body.ravel() == 1).sum() == cloud.target_mask.sum()
    assert (FRAME.body.ravel()[window] == 1).sum() == (FRAME.body == 1).sum()


def test_stored_order_begins_with_a_farthest_point_sample() -> None:
    cloud = observe()
    points = cloud.points_m.astype(np.float32)
    gaps = [np.linalg.norm(points[k] - points[:k], axis=1).min() for k in range(1, 64)]
    # Each next point is the farthest from those before it, so the gaps never grow.
    assert (np.diff(gaps) <= 2e-3).all()
    others = np.linalg.norm(points[64:, None] - points[None, :64], axis=2).min(1)
    assert others.max() <= gaps[-1] + 2e-3


def test_farthest_points_against_a_plain_loop() -> None:
    points = np.random.default_rng(3).normal(size=(200, 3)).astype(np.float32)
    chosen = [0]
    for _ in range(19):
        gap = np.linalg.norm(points[:, None] - points[None, chosen], axis=2).min(1)
        chosen.append(int(gap.argmax()))
    assert farthest_points(points, 20).tolist() == chosen
