"""Paths in time: where they must be, no faster than allowed, at rest at both ends."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from datagen.workers.trials.drive_targets import SPEED_UP_S, lag_compensated, time_parameterized

PERIOD_S = 0.05
SPEED = np.array([1.0, 0.5, 2.0])

corners = st.lists(st.tuples(*[st.floats(-2, 2, allow_subnormal=False)] * 3), min_size=1, max_size=8).map(
    lambda rows: np.array(rows, np.float64)
)


@settings(max_examples=60, deadline=None)
@example(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.4e-277)]), 0.0)
@example(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.015625)]), 0.0)
@example(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.01), (0.0, 0.0, 0.0)]), 0.6)
@given(corners, st.sampled_from([0.0, 0.6, 3.0]))
def test_speeds_jumps_and_ends(path: np.ndarray, at_least_s: float) -> None:
    q = time_parameterized(path, SPEED, PERIOD_S, at_least_s)
    np.testing.assert_array_equal(q[0], path[0])
    np.testing.assert_array_equal(q[-1], path[-1])
    assert (len(q) - 1) * PERIOD_S >= at_least_s - 1e-9
    v = np.diff(q, axis=0) / PERIOD_S
    assert (np.abs(v) <= SPEED * (1 + 1e-6)).all()
    # At a corner a joint may jump by what it gains in a period; two may fall into neighbouring ticks.
    gain = SPEED / SPEED_UP_S * PERIOD_S
    assert (np.abs(np.diff(v, axis=0)) <= 3 * gain + 1e-6).all()
    for row in q:  # on the path
        a, b = path[:-1], path[1:]
        if len(a) == 0:
            continue
        d = b - a
        share = np.clip(np.sum((row - a) * d, axis=1) / np.maximum(np.sum(d * d, axis=1), 1e-18), 0, 1)
        assert np.linalg.norm(row - a - share[:, None] * d, axis=1).min() < 1e-6


def test_a_long_line_runs_at_the_slowest_joints_speed() -> None:
    q = time_parameterized(np.array([[0.0, 0, 0], [4.0, 4.0, 4.0]]), SPEED, PERIOD_S, 0.0)
    v = np.diff(q, axis=0) / PERIOD_S
    assert v.max() == pytest.approx(0.5, rel=0.02)
    assert len(v) * PERIOD_S == pytest.approx(4.0 / 0.5 + SPEED_UP_S, abs=2 * PERIOD_S)


def test_compensated_targets_lead_by_the_lag_and_end_at_the_path() -> None:
    q = time_parameterized(np.array([[0.0, 0, 0], [4.0, 0, 0]]), SPEED, PERIOD_S, 0.0)
    u = lag_compensated(q, PERIOD_S, 0.1)
    middle = len(q) // 2
    assert u[middle, 0] - q[middle, 0] == pytest.approx(0.1, rel=0.02)
    np.testing.assert_array_equal(u[[0, -1]], q[[0, -1]])
