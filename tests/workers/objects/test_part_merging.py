"""Merged parts hold what the parts held, stay few, keep openings open and do not depend on order."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects import open_objects, part_merging
from datagen.workers.objects.convex import opening_depth
from datagen.workers.objects.hulls import distances_m, few_vertices, hull_of
from datagen.workers.objects.part_merging import MAX_VERTICES, merge_parts
from datagen.workers.objects.scan import read_scan
from tests.workers.objects.merging_errors import added_volume_share, cut_off_m, error_m

pytestmark = pytest.mark.slow


def box(low: F64, high: F64) -> F32:
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    return (low + corners * (high - low)).astype(np.float32)


def scattered(seed: int, n: int) -> list[F32]:
    """Convex parts of 8 to 90 points, some near each other and some apart."""
    rng = np.random.default_rng(seed)
    return [
        (rng.normal(size=(int(rng.integers(8, 90)), 3)) * 0.01 + rng.uniform(-0.08, 0.08, 3)).astype(
            np.float32
        )
        for _ in range(n)
    ]


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 14), limit=st.integers(1, 8))
def test_merged_parts_are_few_and_hold_every_vertex(seed: int, n: int, limit: int) -> None:
    parts = scattered(seed, n)
    merged = merge_parts(parts, limit)
    assert len(merged) == min(n, limit)
    is_cut = max(len(part) for part in merged) >= MAX_VERTICES
    assert cut_off_m(parts, merged) <= (0.01 if is_cut else 1e-6)
    if n > limit:
        new = [part for part in merged if not any(np.isin(part, old).all() for old in parts)]
        assert new and max(len(part) for part in new) <= MAX_VERTICES
        assert error_m(parts, merged) > 0


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_neither_order_of_parts_nor_of_vertices_matters(seed: int) -> None:
    parts = scattered(seed, 9)
    rng = np.random.default_rng(seed)
    shuffled = [rng.permutation(parts[k]) for k in rng.permutation(len(parts))]
    first, second = part_merging._merge(parts, 4), part_merging._merge(shuffled, 4)
    assert {k: v.tobytes() for k, v in first.items()} == {k: v.tobytes() for k, v in second.items()}
    assert part_merging._key(parts, 4) == part_merging._key(shuffled, 4) != part_merging._key(parts, 5)


def test_few_parts_stay_as_they_are() -> None:
    parts = scattered(0, 5)
    merged = merge_parts(parts, 5)
    assert all(new is old for new, old in zip(merged, parts, strict=True))
    with pytest.raises(ValueError, match="limit 0"):
        merge_parts(parts, 0)


def test_the_error_is_that_of_a_drawn_case() -> None:
    # An L of two bars: its hull fills a right triangle of a by b between their inner sides. The point of
    # its long side that is farthest from both bars is as far from the one as from the other.
    a, b = 0.05, 0.03
    bars = [
        box(np.array([0, 0, 0]), np.array([0.06, 0.01, 0.01])),
        box(np.array([0, 0.01, 0]), np.array([0.01, 0.04, 0.01])),
    ]
    merged = merge_parts(bars, 1)
    assert error_m(bars, merged) == pytest.approx(a * b / (a + b), abs=0.8 * 0.06 / 128)
    assert added_volume_share(bars, merged) == pytest.approx((a * b / 2) / (0.06 + 0.03) / 0.01, abs=1e-4)


def test_parts_that_fill_a_box_are_joined_without_error() -> None:
    ticks = np.linspace(0, 0.1, 4)
    boxes = [
        box(np.array([x, y, 0]), np.array([x2, y2, 0.02]))
        for x, x2 in pairwise(ticks)
        for y, y2 in pairwise(ticks)
    ]
    merged = merge_parts(boxes, 1)
    assert error_m(boxes, merged) < 1e-6
    assert added_volume_share(boxes, merged) == pytest.approx(0, abs=1e-5)
    assert len(merged[0]) == 8


def test_64_vertices_span_nearly_what_all_span() -> None:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(400, 3))
    ball *= 0.05 / np.linalg.norm(ball, axis=1, keepdims=True)
    few = few_vertices(ball, 64)
    assert few.shape == (64, 3) and np.isin(few, ball).all()
    assert distances_m([hull_of(few)], ball, 0.0005).max() < 0.004
    # A sheet that lies askew has a volume, and no four points may be taken that do not.
    sheet = rng.uniform(-0.1, 0.1, (100, 3)) * [1, 1, 0.002]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert hull_of(few_vertices(hull_of(sheet @ turn).vertices_m, 12)).volume_m3 > 0


def test_merged_parts_are_read_from_the_cache(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = scattered(11, 6)
    monkeypatch.setattr(part_merging, "_known", {})
    first = merge_parts(parts, 2)
    assert merge_parts(parts[::-1], 2) is first
    assert len(list((own_cache / "hulls").iterdir())) == 1

    def refuse(*_: object) -> tuple[F32, ...]:
        raise AssertionError("merged again")

    monkeypatch.setattr(part_merging, "_known", {})
    monkeypatch.setattr(part_merging, "_merge", refuse)
    again = merge_parts(parts, 2)
    assert [part.tobytes() for part in again] == [part.tobytes() for part in first]


def free_depth(visual_m: F32, parts: tuple[F32, ...]) -> F64:
    """How far down from the rim the inside is empty, at points within half the rim's radius: (N,) metres.

    Seen by the parts alone, from above, at a grid of heights 1 mm apart.
    """
    top = float(visual_m[:, 2].max())
    rim = visual_m[visual_m[:, 2] > top - 0.01]
    centre = (rim[:, :2].max(axis=0) + rim[:, :2].min(axis=0)) / 2
    radius = 0.25 * float(np.ptp(rim[:, :2], axis=0).min())
    angle = np.arange(12) * np.pi / 6
    spots = np.concatenate(
        [np.zeros((1, 2)), *(k * radius * np.stack([np.cos(angle), np.sin(angle)], 1) for k in (0.5, 1))]
    )
    heights = np.arange(top, float(visual_m[:, 2].min()), -0.001)
    points = np.array([[*(centre + spot), z] for spot in spots for z in heights])
    filled = np.zeros(len(points), bool)
    for part in parts:
        planes = ConvexHull(part.astype(np.float64)).equations
        filled |= (points @ planes[:, :3].T + planes[:, 3] <= 0).all(axis=1)
    grid = filled.reshape(len(spots), len(heights))
    return np.where(grid.any(axis=1), grid.argmax(axis=1), grid.shape[1]) * 0.001


def check_opening(visual_m: F32, parts: tuple[F32, ...]) -> None:
    merged = merge_parts(parts, 16)
    assert len(merged) == 16
    depth_m = opening_depth(visual_m, parts)
    assert depth_m > 0.03
    assert opening_depth(visual_m, merged) == depth_m
    before, after = free_depth(visual_m, parts), free_depth(visual_m, merged)
    # Fingers reach as far down as before, up to what flat pieces of wall take away at the floor.
    assert after[0] >= before[0] - 0.003
    assert (after >= before - 0.010).all()
    assert error_m(parts, merged) < 0.010 and cut_off_m(parts, merged) < 0.002


@pytest.mark.parametrize("name", ["024_bowl", "065-a_cups", "065-j_cups"])
def test_openings_of_scanned_vessels_stay_open(assets: Path, name: str) -> None:
    folder = assets / "ycb" / name
    scan = read_scan(folder / "textured.obj", folder / "texture_map.jpg", folder / "collision.obj")
    check_opening(scan.visual.vertices_m, scan.parts.vertices_m)


@pytest.mark.parametrize("name", ["024_bowl", "025_mug", "019_pitcher_base"])
def test_openings_of_built_in_vessels_stay_open(name: str) -> None:
    model = open_objects("builtin").load(name)
    check_opening(model.visual.vertices_m, model.convex_parts_m)
