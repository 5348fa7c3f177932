"""The heuristic label against the paper's stated numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.specification import HeuristicParams
from datagen.workers.labels.distance_visibility_score import distance_score, heuristic, visibility_score

PARAMS = HeuristicParams()


def columns(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


@pytest.mark.parametrize(
    ("rho", "score"),
    [(0.0, 0.05), (0.02, 0.175), (0.04, 0.3), (0.5, 0.3), (0.8, 0.3), (0.9, 0.45), (1.0, 0.6)],
)
def test_visibility_score_has_the_papers_values(rho: float, score: float) -> None:
    assert visibility_score(np.array([rho]))[0] == pytest.approx(score)


def test_distance_score_is_asymmetric_around_its_peak_and_zero_outside_the_bounds() -> None:
    assert not distance_score(np.array([0.0, 0.139, 0.921, 1.4]), PARAMS).any()
    params = HeuristicParams(mu=0.5, sigma_l=0.2, sigma_r=0.1)
    scores = distance_score(np.array([0.3, 0.5, 0.6]), params)
    np.testing.assert_allclose(scores, [np.exp(-0.5), 1.0, np.exp(-0.5)])


@pytest.mark.parametrize(("rho", "sigmas"), [(0.5, 0.985), (1.0, 1.545), (0.0, 0.515)])
def test_the_default_rule_is_a_band_of_known_width(rho: float, sigmas: float) -> None:
    params = HeuristicParams(mu=5.0, sigma_l=1.0, sigma_r=1.0, d_min=0.0, d_max=10.0)
    d = columns(*np.linspace(2, 8, 60_001))
    _, label = heuristic(d, d, np.ones_like(d), np.full_like(d, rho), params)
    band = d[label == 1]
    assert 5 - band.min() == pytest.approx(sigmas, abs=2e-3)
    assert band.max() - 5 == pytest.approx(sigmas, abs=2e-3)


@given(st.floats(0, 2), st.floats(0, 1), st.floats(0.3, 1))
def test_label_is_the_stored_score_against_the_threshold(d: float, rho: float, reach: float) -> None:
    score, label = heuristic(columns(d), columns(d), columns(reach), columns(rho), PARAMS)
    assert label[0] == (score[0] >= np.float32(PARAMS.tau))
    assert 0 <= score[0] <= PARAMS.alpha * 0.6 + (1 - PARAMS.alpha) * PARAMS.a + 1e-6


def test_reach_relative_distance_divides_by_the_arm() -> None:
    params = HeuristicParams(distance="planar-over-reach", mu=0.7)
    mount = HeuristicParams(distance="mount-over-reach", mu=0.7)
    relative, _ = heuristic(columns(0.35), columns(0.42), columns(0.5), columns(0.5), params)
    from_mount, _ = heuristic(columns(0.28), columns(0.35), columns(0.5), columns(0.5), mount)
    assert relative[0] == from_mount[0] == pytest.approx(0.51 * 0.3 + 0.49)
