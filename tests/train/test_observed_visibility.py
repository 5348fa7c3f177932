"""The estimate of rho, held against rays through scenes simple enough to know everything of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datagen.train import observed_visibility as ov
from datagen.train.observed_visibility import visible_share

RADIUS_M = 0.06
WALL_M = 0.3  # from the target, across the x axis


def sphere(n: int = 256) -> np.ndarray:
    """Points of the half that a camera at +x sees, in an order of which any prefix covers it."""
    rng = np.random.default_rng(1)
    p = rng.normal(size=(n, 3))
    p *= RADIUS_M / np.linalg.norm(p, axis=1, keepdims=True)
    p[:, 0] = np.abs(p[:, 0])
    return p.astype(np.float32)


def wall(low_y: float, high_y: float, spacing_m: float = 0.01) -> np.ndarray:
    """Points of a wall from the floor to well above the target, spread like those of a stored cloud."""
    y, z = np.meshgrid(np.arange(low_y, high_y, spacing_m), np.arange(-0.4, 0.5, spacing_m))
    off = np.random.default_rng(2).uniform(0, spacing_m, (2, y.size))
    y, z = np.minimum(y.ravel() + off[0], high_y), z.ravel() + off[1]
    return np.column_stack([np.full(y.size, WALL_M), y, z]).astype(np.float32)


def table(height_m: float, spacing_m: float = 0.015) -> np.ndarray:
    rng = np.random.default_rng(3)
    n = int(1.2**2 / spacing_m**2)
    return np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)), np.full(n, height_m)]).astype(np.float32)


def true_share(eye: np.ndarray, low_y: float, high_y: float) -> float:
    """Of the rays from the eye that hit the sphere, those that miss the wall."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    a, b = (np.array(g).ravel() for g in np.meshgrid(*[np.linspace(-1, 1, 61)] * 2))
    sine = RADIUS_M / np.linalg.norm(eye)
    half = sine / np.sqrt(1 - sine**2)
    rays = forward + half * (a[:, None] * right + b[:, None] * up)
    rays = rays[a**2 + b**2 < 1]
    reached = (WALL_M - eye[0]) / np.where(rays[:, 0] == 0, 1e-12, rays[:, 0])
    at = eye + reached[:, None] * rays
    stopped = (reached > 0) & (at[:, 1] > low_y) & (at[:, 1] < high_y) & (at[:, 2] > -0.4) & (at[:, 2] < 0.5)
    # What lies behind the sphere stops no ray to it.
    stopped &= reached * np.linalg.norm(rays, axis=1) < np.linalg.norm(eye)
    return 1 - stopped.mean()


def share(others: np.ndarray, eye: tuple[float, float, float], target: np.ndarray | None = None) -> float:
    eyes = np.array([eye], np.float32)
    return float(visible_share(others, sphere() if target is None else target, RADIUS_M, eyes)[0])


@settings(max_examples=25, deadline=None)
@given(
    low=st.floats(-0.3, 0.1),
    width=st.floats(0.1, 0.5),
    angle=st.floats(-0.6, 0.6),
    eye_m=st.floats(0.6, 1.1),
    height=st.floats(-0.1, 0.4),
)
def test_estimate_agrees_with_rays(
    low: float, width: float, angle: float, eye_m: float, height: float
) -> None:
    eye = np.array([eye_m * np.cos(angle), eye_m * np.sin(angle), height])
    high, found = low + width, share(wall(low, low + width), tuple(eye))
    # Discs around the wall's points reach over its ends, by about their radius.
    assert true_share(eye, low - 0.015, high + 0.015) - 0.05 <= found <= true_share(eye, low, high) + 0.05


def plain_share(others: np.ndarray, eye: np.ndarray) -> float:
    """The same by its definition: one eye, every disc against every cell."""
    view = ov.Views(eye[None], RADIUS_M)
    whole = np.concatenate([sphere()[:128], sphere()[:128] * np.array([-1, -1, 1], np.float32)])
    front = ov.closed(view.nearest_m(whole))
    discs = ov.fit_discs(others, np.ones(len(others), np.bool_))
    towards, right, up = view.towards[0], view.right[0], view.up[0]
    along = (discs.centre_m @ towards)[:, None, None]
    ahead = view.distance_m[0] - along
    cell = ahead * view.half_m[0] / view.distance_m[0] / 8  # a sixteenth of the window's width
    dy, dx = (c + 0.5 for c in np.indices((16, 16)))
    dx, dy = (d - (discs.centre_m @ axis)[:, None, None] / cell - 8 for d, axis in ((dx, right), (dy, up)))
    facing = (discs.normal @ towards)[:, None, None]
    facing = np.where(np.abs(facing) < 1e-3, 1e-3, facing)
    rise = -((discs.normal @ right)[:, None, None] * dx + (discs.normal @ up)[:, None, None] * dy)
    own = (np.abs(dx) <= 0.5) & (np.abs(dy) <= 0.5)
    rise = np.where(own, 0, rise * cell / facing)
    radius = discs.radius_m[:, None, None]
    covered = own | ((dx**2 + dy**2) * cell**2 + rise**2 <= radius**2)
    across2 = (discs.centre_m**2).sum(1)[:, None, None] - along**2
    beside = across2 <= (np.sqrt(2) * view.half_m[0] / view.distance_m[0] * ahead + radius) ** 2
    hidden = (covered & beside & (ahead > 0.02) & (front > -np.inf) & (along + rise > front + 0.02)).any(0)
    on_target = front > -np.inf
    seen = on_target & ~ov.majority(hidden[None], on_target)
    return float(seen.sum() / on_target.sum())


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_estimate_equals_every_disc_against_every_cell(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pole = rng.normal([0.2, 0.15, 0.1], [0.01, 0.01, 0.2], (60, 3))
    blob = rng.normal([-0.15, 0.0, 0.03], 0.02, (300, 3))  # its discs are smaller than cells
    others = np.concatenate([wall(-0.2, 0.1, 0.04), table(-0.07, 0.05), pole, blob]).astype(np.float32)
    eyes = np.column_stack([rng.uniform(-1, 1, (40, 2)), rng.uniform(-0.1, 0.6, 40)]).astype(np.float32)
    found = visible_share(others, sphere(), RADIUS_M, eyes)
    assert 0.05 < (found > 0.9).mean() < 0.98 or found.std() > 0.1
    rows = np.flatnonzero(np.linalg.norm(eyes, axis=1) > 1.05 * RADIUS_M)[:6]
    # A cell at a disc's very rim may fall to either side by rounding.
    np.testing.assert_allclose(found[rows], [plain_share(others, eyes[row]) for row in rows], atol=0.02)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10_000))
def test_testing_eyes_by_sectors_changes_nothing(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    rng = np.random.default_rng(seed)
    heaps = np.repeat(rng.normal(0, [0.3, 0.3, 0.15], (8, 3)), 30, axis=0)
    others = np.concatenate([table(-0.07, 0.05), rng.normal(heaps, 0.03)]).astype(np.float32)
    eyes = rng.normal(0, [0.5, 0.5, 0.5], (60, 3)).astype(np.float32)
    eyes[0] = [0, 0, 0.8]  # straight above
    flat = (sphere() * rng.uniform(0.2, 1, 3)).astype(np.float32)  # fills a part of the window
    shares: list[np.ndarray] = []
    for at_once in (1, 7, 60):
        monkeypatch.setattr(ov, "_EYES_AT_ONCE", at_once)
        shares.append(visible_share(others, flat, RADIUS_M, eyes))
    assert shares[0].std() > 0.05
    # A cell at a disc's very rim may fall to either side by rounding.
    np.testing.assert_allclose(shares[:2], shares[2:] * 2, atol=0.02)


def test_a_table_hides_what_stands_on_it_only_from_below() -> None:
    below = table(-RADIUS_M - 0.002)
    assert share(below, (0.7, 0.1, 0.5)) > 0.95
    assert share(below, (0.7, 0.1, 0.2)) > 0.9
    assert share(below, (0.5, 0.1, -0.4)) < 0.3  # its foot is no farther than the margin


@settings(max_examples=15, deadline=None)
@given(angle=st.floats(-3.1, 3.1), seed=st.integers(0, 100))
def test_rotating_the_scene_with_the_eyes_changes_nothing(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    eyes = np.column_stack([rng.uniform(-1, 1, (20, 2)), rng.uniform(0, 0.6, 20)])
    others, target = wall(-0.2, 0.2), sphere()
    plain = visible_share(others, target, RADIUS_M, eyes.astype(np.float32))
    turned = [(a @ turn.T).astype(np.float32) for a in (others, target, eyes)]
    np.testing.assert_allclose(visible_share(turned[0], turned[1], RADIUS_M, turned[2]), plain, atol=0.06)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 100))
def test_more_walls_never_show_more(seed: int) -> None:
    rng = np.random.default_rng(seed)
    eyes = np.column_stack([rng.uniform(0.4, 1, 20), rng.uniform(-0.5, 0.5, 20), rng.uniform(0, 0.5, 20)])
    left = wall(-0.3, 0.0)
    far = wall(0.0, 0.3) + np.array([0.1, 0, 0], np.float32)  # 10 cm behind: no neighbours
    one = visible_share(left, sphere(), RADIUS_M, eyes.astype(np.float32))
    both = visible_share(np.concatenate([left, far]), sphere(), RADIUS_M, eyes.astype(np.float32))
    assert (both <= one + 1e-9).all()


def test_visibility_is_whole_without_an_occluder_and_zero_without_target_points_or_inside_the_target() -> (
    None
):
    nothing, bad = np.zeros((0, 3), np.float32), np.full((3, 3), np.nan, np.float32)
    for others in (nothing, bad):  # points that are no numbers are left out
        target = np.concatenate([others, sphere()])
        assert share(others, (0.8, 0.1, 0.4), target) == 1
        assert share(others, (0.0, 0.0, 0.8), target) == 1  # straight above: no way is right
        assert share(others, (0.0, 0.0, 0.05), target) == 0
        assert share(others, (0.8, 0, 0.4), target=nothing) == 0
    behind = np.concatenate([bad, wall(-0.3, 0.3)])
    assert share(behind, (0.8, 0.05, 0.1)) < 0.04
    assert share(behind, (-0.8, 0.1, 0.4)) == 1  # from the other side
