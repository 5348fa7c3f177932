"""Floor polygons: triangles fill them exactly, whatever their shape."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.walls_and_floors import clean_polygon, triangles


def area(p: np.ndarray) -> float:
    q = np.roll(p, -1, axis=0)
    return float(0.5 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum())


@given(st.integers(3, 40), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=100, deadline=None)
def test_triangles_fill_any_star_shaped_polygon(corners: int, seed: int, is_clockwise: bool):
    rng = np.random.default_rng(seed)
    angle = np.sort((np.arange(corners) + rng.uniform(0, 0.9, corners)) * 2 * np.pi / corners)
    radius = rng.uniform(1.0, 5.0, corners)
    polygon = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    cleaned = clean_polygon(polygon[::-1] if is_clockwise else polygon)
    if isinstance(cleaned, str):
        assert corners < 5  # three or four corners may leave the centre out
        return
    pieces = [cleaned[list(t)] for t in triangles(cleaned)]
    assert len(pieces) == len(cleaned) - 2
    assert all(area(t) >= -1e-9 for t in pieces)
    assert np.isclose(sum(area(t) for t in pieces), area(cleaned))
    middles = np.array([t.mean(0) for t in pieces if area(t) > 1e-6])
    assert inside_polygon(middles, cleaned).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_rooms_with_right_angles_and_repeated_corners(seed: int):
    rng = np.random.default_rng(seed)
    a, b, c, d = rng.uniform(1, 4, 4)
    polygon = np.array(
        [[0, 0], [a + b, 0], [a + b, 0], [a + b, c], [a, c], [a, c + d], [a / 2, c + d], [0, c + d]]
    )
    cleaned = clean_polygon(polygon)
    assert not isinstance(cleaned, str)
    assert len(cleaned) == 6
    assert np.isclose(sum(area(cleaned[list(t)]) for t in triangles(cleaned)), (a + b) * c + a * d)
