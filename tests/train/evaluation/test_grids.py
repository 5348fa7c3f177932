"""Grid selection by brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.train.evaluation.grids import picks, select
from datagen.train.evaluation.metrics import average_precision


@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 3))
@settings(deadline=None)
def test_selection_equals_brute_force(seed: int, side: int, levels: int) -> None:
    rng = np.random.default_rng(seed)
    n_groups, cells = 4, side * side
    group = rng.permutation(np.repeat(np.arange(n_groups), cells))
    xy = rng.uniform(-1, 1, (n_groups * cells, 2)).astype(np.float32)
    score = rng.choice([-np.inf, *range(levels)], len(group))
    true, allowed = rng.random(len(group)) < 0.3, rng.random(len(group)) < 0.6
    found = select(score, true, xy, group, allowed)
    row = 0
    for g in range(n_groups):
        members = [k for k in range(len(group)) if group[k] == g and allowed[k]]
        positives = [k for k in members if true[k]]
        if not positives:
            continue
        best = max(score[k] for k in members)
        tied = [k for k in members if score[k] == best]
        wrong = [min(np.hypot(*(xy[k] - xy[p])) for p in positives) for k in tied if not true[k]]
        assert found.group[row] == g
        assert found.good[row] == pytest.approx(1 - len(wrong) / len(tied))
        assert found.missed_m[row] == pytest.approx(np.mean(wrong) if wrong else 0, abs=1e-6)
        assert found.precision[row] == pytest.approx(average_precision(true[members], score[members]))
        row += 1
    assert row == len(found.group)


def test_ties_share_a_pick_and_nothing_allowed_picks_nothing() -> None:
    group = np.array([0, 0, 0, 1, 1, 2])
    share = picks(
        np.array([1.0, 1, 0, -np.inf, -np.inf, 5]), group, np.array([True, True, True, True, True, False])
    )
    assert share.tolist() == [0.5, 0.5, 0, 0.5, 0.5, 0]
    assert not picks(np.zeros(6), group, np.zeros(6, np.bool_)).any()


def test_a_scorer_that_knows_the_truth_never_misses() -> None:
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(20), 30)
    true, xy = rng.random(600) < 0.2, rng.uniform(-1, 1, (600, 2))
    found = select(true.astype(np.float64), true, xy, group, np.ones(600, np.bool_))
    assert (found.good == 1).all() and (found.missed_m == 0).all() and (found.precision == 1).all()
    worst = select(-true.astype(np.float64), true, xy, group, np.ones(600, np.bool_))
    assert (worst.good == 0).all() and (worst.missed_m > 0).all()
    # All good ones come last, with one score.
    assert worst.precision == pytest.approx(np.bincount(group, true) / 30)
