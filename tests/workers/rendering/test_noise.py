"""The depth noise model: what it loses, how far off it is, and what it leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.specification import NoiseParams
from datagen.workers.geometry.mesh import F32
from datagen.workers.rendering import Camera, Frame
from datagen.workers.rendering.noise import add_noise

ONLY_MATCHING = NoiseParams(enabled=True, grazing_dropout_cos=0.0, edge_dropout=0.0, hole_rate=0.0)
QUIET = {"disparity_std_px": 0.0, "grazing_dropout_cos": 0.0, "edge_dropout": 0.0, "hole_rate": 0.0}


def frame_of(depth_m: F32, fx_px: float = 600.0) -> Frame:
    h, w = depth_m.shape
    camera = Camera(np.eye(4), w, h, fx_px, fx_px, w / 2, h / 2)
    body = np.where(depth_m > 0, 0, -1).astype(np.int16)
    rgb = np.random.default_rng(0).integers(0, 256, (h, w, 3)).astype(np.uint8)
    return Frame(camera, rgb, depth_m.astype(np.float32), body)


def wall(depth_m: float, size: int = 160) -> Frame:
    return frame_of(np.full((size, size), depth_m, np.float32))


def noisy(frame: Frame, params: NoiseParams, seed: int = 0) -> F32:
    return add_noise(frame, params, np.random.default_rng(seed)).depth_m


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.builds(
        NoiseParams,
        disparity_std_px=st.floats(0, 5),
        baseline_m=st.floats(0.001, 1),
        grazing_dropout_cos=st.floats(0, 1),
        edge_dropout=st.floats(0, 1),
        hole_rate=st.floats(0, 1),
    ),
    st.integers(0, 2**32 - 1),
)
def test_any_frame_comes_out_finite_with_zeros_kept_and_the_rest_of_it_untouched(
    h: int, w: int, params: NoiseParams, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    depth_m = rng.uniform(0.02, 60, (h, w)).astype(np.float32)
    depth_m[rng.random((h, w)) < 0.2] = 0
    frame = frame_of(depth_m)
    exact = frame.depth_m.copy()
    out = add_noise(frame, params, np.random.default_rng(seed))
    assert out.depth_m.dtype == np.float32 and out.depth_m.shape == (h, w)
    assert np.isfinite(out.depth_m).all() and (out.depth_m >= 0).all()
    assert not out.depth_m[exact == 0].any()
    assert out.rgb is frame.rgb and out.body is frame.body
    np.testing.assert_array_equal(frame.depth_m, exact)  # the exact frame is left as it was
    np.testing.assert_array_equal(out.depth_m, noisy(frame, params, seed))


@pytest.mark.parametrize("depth_m", [0.5, 1.0, 2.0])
def test_errors_are_unbiased_and_grow_with_the_square_of_depth(depth_m: float) -> None:
    error_m = noisy(wall(depth_m), ONLY_MATCHING) - depth_m
    step_px = 1 / 32
    sigma_px = np.hypot(ONLY_MATCHING.disparity_std_px, step_px / np.sqrt(12))
    expected_m = depth_m**2 * sigma_px / (600 * ONLY_MATCHING.baseline_m)
    assert error_m.std() == pytest.approx(expected_m, rel=0.03)
    assert abs(error_m.mean()) < 4 * expected_m / 160 + depth_m * (sigma_px * depth_m / 30) ** 2


def test_disparity_comes_in_steps_of_a_32nd_of_a_pixel() -> None:
    steps = 32 * 600 * ONLY_MATCHING.baseline_m / noisy(wall(1.3), ONLY_MATCHING).astype(np.float64)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    assert len(np.unique(np.round(steps))) > 5


@settings(max_examples=15, deadline=None)
@given(st.floats(0.0, 0.6), st.integers(0, 2**32 - 1))
def test_holes_cover_the_share_asked_for_and_are_blobs(rate: float, seed: int) -> None:
    lost = noisy(wall(1.0, 300), NoiseParams(**{**QUIET, "hole_rate": rate}), seed) == 0
    # Discs of about 22 pixels: the share of 90,000 pixels varies by about sqrt(rate * 22 / 90,000).
    assert lost.mean() == pytest.approx(rate, abs=6 * np.sqrt(rate * 25 / 90_000) + 1e-9)
    if lost.sum() > 500:
        beside = (lost[1:] & lost[:-1]).sum() / lost[:-1].sum()
        assert beside > lost.mean() + 0.15  # single pixels at random would give lost.mean()


def test_edges_lose_the_share_asked_for_and_nothing_else_does() -> None:
    depth_m = np.full((200, 200), 2.0, np.float32)
    depth_m[:, 100:] = 1.0
    lost = noisy(frame_of(depth_m), NoiseParams(**{**QUIET, "edge_dropout": 0.5})) == 0
    assert lost[:, 99:101].mean() == pytest.approx(0.5, abs=0.1)
    assert not lost[:, :99].any() and not lost[:, 101:].any()


@pytest.mark.parametrize(("tilt_deg", "seen"), [(0, True), (60, True), (78, True), (84, False)])
def test_surfaces_at_a_grazing_angle_are_lost(tilt_deg: float, seen: bool) -> None:
    # A plane through (0, 0, 2) turned about y; fx is large, so that all rays are nearly parallel.
    # The limit 0.15 is the cosine of 81.4 degrees.
    x = (np.arange(101) + 0.5 - 50.5) / 2000
    row = 2 / (1 + x * np.tan(np.radians(tilt_deg)))
    frame = frame_of(np.tile(row, (50, 1)).astype(np.float32), 2000.0)
    lost = noisy(frame, NoiseParams(**{**QUIET, "grazing_dropout_cos": 0.15})) == 0
    assert lost.mean() < 0.01 if seen else lost.mean() > 0.99
