"""Agreement with intervals: against counts by hand, and simulated scenes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datagen.reports.scene_intervals import cohen_kappa, estimates_by_group


def estimate(said: Any, true: Any, scene: Any) -> dict[str, Any]:
    group = np.zeros(len(said), np.int64)
    (found,) = estimates_by_group(np.array(said, bool), np.array(true, bool), np.array(scene), group, 1)
    return found


def test_kappa_of_counts_by_hand() -> None:
    # Both say yes 20 times, no 15; 5 and 10 differ: 0.70 observed, 0.50 by chance (a textbook example).
    assert cohen_kappa(np.array([20.0, 5.0, 10.0, 15.0])) == pytest.approx(0.4)
    assert cohen_kappa(np.array([30.0, 0.0, 0.0, 70.0])) == pytest.approx(1.0)
    assert np.isnan(cohen_kappa(np.array([0.0, 0.0, 0.0, 9.0])))  # chance alone agrees


def test_groups_share_resamples_and_have_their_own_values() -> None:
    rng = np.random.default_rng(3)
    said, true = rng.random(400) < 0.4, rng.random(400) < 0.5
    scene, group = np.repeat(np.arange(40) * 7, 10), rng.integers(0, 3, 400)
    found = estimates_by_group(said, true, scene, group, 3)
    assert sum(one["count"] for one in found) == 400
    for g, one in enumerate(found):
        rows = group == g
        assert one["accuracy"] == pytest.approx((said == true)[rows].mean())
        assert one["scenes"] == len(np.unique(scene[rows]))
        low, high = one["accuracy_interval"]
        assert low < one["accuracy"] < high
    assert found == estimates_by_group(said, true, scene, group, 3)


def test_candidates_of_one_scene_are_one_observation() -> None:
    # 20 scenes, each right or wrong as a whole: the interval is that of 20 draws, not of 2,000.
    right = np.repeat(np.arange(20) % 4 != 0, 100)
    true = np.tile(np.arange(100) % 2 == 0, 20)
    low, high = estimate(true == right, true, np.repeat(np.arange(20), 100))["accuracy_interval"]
    standard_error = np.sqrt(0.75 * 0.25 / 20)
    assert high - low == pytest.approx(2 * 1.96 * standard_error, rel=0.15)


def test_intervals_by_scene_cover_the_true_share() -> None:
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(200):
        share = np.repeat(rng.beta(4, 2, 60), 10)  # each scene has its own accuracy; their mean is 2/3
        true = rng.random(600) < 0.5
        said = np.where(rng.random(600) < share, true, ~true)
        low, high = estimate(said, true, np.repeat(np.arange(60), 10))["accuracy_interval"]
        held += low <= 2 / 3 <= high
    assert 0.9 <= held / 200 <= 0.98


def test_undefined_values_are_none() -> None:
    nothing = estimate([], [], [])
    assert nothing["count"] == nothing["scenes"] == 0
    assert all(nothing[name] is None for name in ("accuracy", "kappa", "accuracy_interval"))
    one_scene = estimate([1, 0], [1, 1], [4, 4])
    assert one_scene["accuracy"] == 0.5 and one_scene["accuracy_interval"] is None
    assert one_scene["balanced_accuracy"] is None
