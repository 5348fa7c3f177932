"""Augmentations: what each changes, and that names, labels, distances and rows stay in order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.train.augment import Augmentation, ColourJitter, DepthHoles, PointDropout, Rotation, SensorNoise
from datagen.train.batching import StoredScene, View
from datagen.train.dataset import SampleStream
from datagen.workers.rendering.cloud import farthest_points
from tests.made_runs import resign
from tests.train.stream_runs import make_stream_run

SEEDS = st.integers(0, 2**32)
ALL = Augmentation(SensorNoise(), DepthHoles(), PointDropout(), ColourJitter(), Rotation())
many = settings(max_examples=40, deadline=None)


def view_of(seed: int, n: int = 120, size: int = 128, farthest: int = 40) -> View:
    """A table top with a target on it, seen from 1.5 m away; its first rows are a farthest-point sample."""
    rng = np.random.default_rng(seed)
    points_m = rng.uniform((-0.8, -0.8, -0.05), (0.8, 0.8, 0), (n, 3))
    target = rng.random(n) < rng.uniform(0.02, 0.3)
    target[rng.integers(n)] = True
    points_m[target] = rng.uniform(-0.05, 0.05, (target.sum(), 3))
    first = farthest_points(points_m.astype(np.float32), min(farthest, n))
    rows = np.concatenate([first, np.setdiff1d(np.arange(n), first)])
    cloud = np.zeros((size, 3), np.float32)
    cloud[:n] = points_m[rows]
    mask = np.zeros(size, np.bool_)
    mask[:n] = target[rows]
    rgb = np.zeros((size, 3), np.uint8)
    rgb[:n] = rng.integers(0, 256, (n, 3))
    center_m = rng.uniform(-5, 5, 3) + (0, 0, 6)
    T = np.eye(4)
    forward = np.array([-1.2, 0, -0.9]) / 1.5
    right = np.array([0, 1.0, 0])
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = center_m - 1.5 * forward
    record = {"target_center_m": center_m, "T_world_camera": T}
    base_xy_m = rng.uniform(-1, 1, (8, 2))
    return View(StoredScene(record, {}), np.arange(8), cloud, rgb, mask, n, base_xy_m)


def assert_whole(view: View, before: View) -> None:
    """Shapes and types as before, zeros after the last point, and something of the target."""
    n = view.n_points
    assert 1 <= n <= before.n_points
    for name in ("points_m", "rgb", "target_mask"):
        values, old = getattr(view, name), getattr(before, name)
        assert (values.dtype, values.shape) == (old.dtype, old.shape)
        assert not values[n:].any()
    assert view.target_mask[:n].any()
    assert view.scene is before.scene
    assert view.rows is before.rows


def rows_in(view: View, before: View) -> np.ndarray:
    """Which rows of the cloud before remain, given that points were not moved."""
    old = {tuple(p): i for i, p in enumerate(before.points_m[: before.n_points].tolist())}
    return np.array([old[tuple(p)] for p in view.points_m[: view.n_points].tolist()])


@given(SEEDS, SEEDS)
@many
def test_all_together_keep_names_and_leave_a_target(scene: int, seed: int):
    before, whole = view_of(scene), view_of(scene)
    after, again = ALL.apply(before, (seed, 1)), ALL.apply(before, (seed, 1))
    assert_whole(after, before)
    for name in ("points_m", "rgb", "target_mask", "base_xy_m"):
        np.testing.assert_array_equal(getattr(before, name), getattr(whole, name))  # as it was read
        np.testing.assert_array_equal(getattr(after, name), getattr(again, name))


@given(SEEDS, SEEDS, st.floats(0, np.pi))
@many
def test_rotation_keeps_heights_and_all_distances(scene: int, seed: int, largest: float):
    before = view_of(scene)
    after = Rotation(largest).apply(before, np.random.default_rng(seed))
    assert_whole(after, before)
    np.testing.assert_array_equal(after.points_m[:, 2], before.points_m[:, 2])
    np.testing.assert_array_equal(after.rgb, before.rgb)
    lengths = [np.linalg.norm(v.base_xy_m, axis=1) for v in (before, after)]
    np.testing.assert_allclose(*lengths, rtol=1e-12)
    sides = [v.base_xy_m[:, None] - v.points_m[None, : v.n_points, :2] for v in (before, after)]
    np.testing.assert_allclose(*(np.linalg.norm(side, axis=2) for side in sides), atol=1e-6)
    turns = [np.arctan2(v.base_xy_m[:, 1], v.base_xy_m[:, 0]) for v in (before, after)]
    angles = (turns[1] - turns[0] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(angles).max() <= largest + 1e-9
    # Anticlockwise seen from above, for the cloud as for the bases.
    if abs(angles[0]) < 3:
        np.testing.assert_allclose(angles, angles[0], atol=1e-9)


@given(SEEDS, SEEDS, st.floats(0, 1))
@many
def test_dropout_keeps_order_and_spacing(scene: int, seed: int, share: float):
    before = view_of(scene)
    after = PointDropout(share).apply(before, np.random.default_rng(seed))
    assert_whole(after, before)
    kept = rows_in(after, before)
    assert (np.diff(kept) > 0).all()
    np.testing.assert_array_equal(after.rgb[: len(kept)], before.rgb[kept])
    np.testing.assert_array_equal(after.target_mask[: len(kept)], before.target_mask[kept])
    # The first m that remain are as far apart as the stored rows up to the last of them.
    for m in range(2, min(20, len(kept))):
        if kept[m - 1] < 40:
            assert spacing(after.points_m[:m]) >= spacing(before.points_m[: kept[m - 1] + 1])


def spacing(points_m: np.ndarray) -> float:
    gaps = np.linalg.norm(points_m[:, None] - points_m[None], axis=2)
    return float(gaps[np.triu_indices(len(points_m), 1)].min())


def rays_of(view: View) -> np.ndarray:
    """The points (N, 3), seen from the camera that observed them, world axes."""
    camera_m = view.scene.record["T_world_camera"][:3, 3] - view.scene.record["target_center_m"]
    return view.points_m[: view.n_points].astype(np.float64) - camera_m


@given(SEEDS, SEEDS, st.integers(0, 12), st.floats(0, 1.5), st.floats(0, 1))
@many
def test_holes_are_cones_from_the_camera_and_spare_the_target(
    scene: int, seed: int, most: int, largest: float, kept_share: float
):
    before = view_of(scene)
    after = DepthHoles(most, largest, kept_share).apply(before, np.random.default_rng(seed))
    assert_whole(after, before)
    kept = rows_in(after, before)
    assert (np.diff(kept) > 0).all()
    assert after.target_mask.sum() >= kept_share * before.target_mask.sum()
    lost = np.setdiff1d(np.arange(before.n_points), kept)
    sight = rays_of(before)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    # Each lost point lies in a cone about a point that was lost too.
    if len(lost):
        assert (sight[lost] @ sight[lost].T >= np.cos(largest) - 1e-6).any(axis=1).all()
    assert most or not len(lost)


@given(SEEDS, SEEDS, st.floats(0, 0.02))
@many
def test_noise_moves_points_along_their_rays(scene: int, seed: int, std: float):
    before = view_of(scene)
    after = SensorNoise(std).apply(before, np.random.default_rng(seed))
    assert_whole(after, before)
    assert after.n_points == before.n_points
    rays = [rays_of(view) for view in (before, after)]
    aside = np.linalg.norm(np.cross(*rays), axis=1) / np.linalg.norm(rays[0], axis=1)
    assert aside.max() < 1e-5


def test_noise_grows_with_the_square_of_depth():
    views = [view_of(0, n=128) for _ in range(2)]
    record = views[1].scene.record
    T = record["T_world_camera"].copy()
    T[:3, 3] = record["target_center_m"] - 3.0 * T[:3, 2]  # twice as far
    far = replace(views[1], scene=StoredScene({**record, "T_world_camera": T}, {}))
    moves = []
    for view in (views[0], far):
        after = [SensorNoise(0.002).apply(view, np.random.default_rng(s)) for s in range(20)]
        moved = np.concatenate([np.linalg.norm(a.points_m - view.points_m, axis=1) for a in after])
        moves.append(np.sqrt((moved**2).mean()))
    assert 3.3 < moves[1] / moves[0] < 4.7
    assert 0.8 < moves[0] / (0.002 * 1.5**2) < 1.4


@given(SEEDS, SEEDS)
@many
def test_colours_are_scaled_and_padding_stays_black(scene: int, seed: int):
    before = view_of(scene)
    after = ColourJitter(0.2, 0.1).apply(before, np.random.default_rng(seed))
    assert_whole(after, before)
    np.testing.assert_array_equal(after.points_m, before.points_m)
    for channel in range(3):
        old, new = before.rgb[:, channel].astype(float), after.rgb[:, channel].astype(float)
        free = (old > 20) & (new < 255)
        gains = new[free] / old[free]
        assert np.ptp(gains) < 0.06  # one gain a channel, but for rounding
        assert 0.7 < gains.mean() < 1.33


def test_effects_are_there_and_have_independent_random_numbers():
    before = view_of(1)
    sizes = [DepthHoles(8, 0.1).apply(before, np.random.default_rng(s)).n_points for s in range(10)]
    assert min(sizes) < before.n_points
    alone = Augmentation(rotation=Rotation()).apply(before, (0, 1))
    together = replace(ALL, noise=None, holes=None, dropout=None).apply(before, (0, 1))
    np.testing.assert_array_equal(alone.points_m, together.points_m)
    empty = replace(before, n_points=0)
    assert ALL.apply(empty, (0,)) is empty


def test_the_camera_pose_is_read_only_for_effects_that_need_it(tmp_path):
    assert Augmentation(None, None, PointDropout(), ColourJitter(), Rotation()).fields == ()
    folder = tmp_path / "run"
    make_stream_run(folder, 18)
    for path in (folder / "shards").glob("*.zip"):
        resign(Run.open(folder), path.stem, {"T_world_camera/c.0.0.0": b"damaged"})
    assert len(list(SampleStream([folder], augment=replace(ALL, noise=None, holes=None)).epoch(0))) == 1
    with pytest.raises(InputError, match=r"T_world_camera: .*crc32c"):
        list(SampleStream([folder], augment=ALL).epoch(0))


@pytest.mark.parametrize("k", [0, 3])
def test_labels_and_names_are_those_of_the_plain_stream(tmp_path: Path, k: int):
    make_stream_run(tmp_path, 36)
    streams = (SampleStream([tmp_path], augment=augment).epoch(k) for augment in (ALL, None))
    for ours, plain in zip(*streams, strict=True):
        np.testing.assert_array_equal(ours.sample_id, plain.sample_id)
        np.testing.assert_array_equal(ours.label, plain.label)
        lengths = [np.linalg.norm(b.candidates.base_xy_m.astype(np.float64), axis=1) for b in (ours, plain)]
        np.testing.assert_allclose(*lengths, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Rotation(-1), "largest_rad"),
        (lambda: PointDropout(1.5), "largest_share"),
        (lambda: ColourJitter(channel=2), "channel"),
        (lambda: SensorNoise(float("nan")), "std_at_1m_m"),
        (lambda: DepthHoles(most=-1), "most"),
    ],
)
def test_numbers_out_of_range_are_refused(make, field: str):
    with pytest.raises(InputError, match=f"augmentation: {field}: .* is not between"):
        make()
