"""The frame in which errors are mapped: origin at the target, the nearest edge of its support below."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.reports.error_map import CELL_M, error_map
from datagen.reports.target_frame import SIDES, in_edge_frame, side_of, towards_nearest_edge


def support(turn: float, centre: tuple[float, float]) -> np.ndarray:
    c, s = np.cos(turn), np.sin(turn)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:2, 3] = centre
    return T


@pytest.mark.parametrize("turn", [0.0, 0.7, np.pi / 2, -2.5])
@pytest.mark.parametrize(
    ("offset", "edge"),
    [((0.5, 0.0), (1, 0)), ((-0.5, 0.1), (-1, 0)), ((0.1, 0.3), (0, 1)), ((0, -0.3), (0, -1))],
)
def test_the_nearest_edge_points_down_however_the_support_is_turned(
    turn: float, offset: tuple[float, float], edge: tuple[float, float]
) -> None:
    T = support(turn, (3.0, -2.0))
    target = T[:2, :2] @ np.array(offset) + T[:2, 3]
    centre_m = np.array([[*target, 0.8]])
    towards = towards_nearest_edge(T[None], np.array([[1.2, 0.8]], np.float32), centre_m)
    np.testing.assert_allclose(towards[0], T[:2, :2] @ np.array(edge), atol=1e-12)
    # A base half a metre across that edge, and one at its right hand seen from above.
    across = target + 0.5 * towards[0]
    right = target + 0.2 * np.array([-towards[0, 1], towards[0, 0]])
    found = in_edge_frame(
        np.stack([across, right]), *(np.repeat(a, 2, axis=0) for a in (target[None], towards))
    )
    np.testing.assert_allclose(found, [[0, -0.5], [0.2, 0]], atol=1e-12)
    assert [SIDES[k] for k in side_of(found)] == ["nearest edge", "right"]


def test_the_map_counts_each_candidate_in_its_cell() -> None:
    xy_m = np.array([[0.01, 0.02], [0.09, 0.05], [-0.01, 0.02], [0.31, -0.79], [5.0, 0.0]])
    said, true = np.array([1, 0, 0, 1, 1], bool), np.array([0, 1, 0, 1, 0], bool)
    found = error_map(said, true, xy_m)
    cells = {
        (x, y): counts
        for x, y, *counts in zip(
            *(found[name] for name in ("x_m", "y_m", "count", "false_positive", "false_negative")),
            strict=True,
        )
    }
    assert CELL_M == 0.1 and found["outside"] == 1
    assert cells == {(0.05, 0.05): [2, 1, 1], (-0.05, 0.05): [1, 0, 0], (0.35, -0.75): [1, 0, 0]}
