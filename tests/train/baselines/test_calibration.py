"""Chances from scores of any scale."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.train.baselines.baseline import Unfitted
from datagen.train.baselines.calibration import calibrate
from datagen.train.inputs import F64, Batch, is_clear
from tests.train.baselines.scenes import make_batch


@dataclass(frozen=True, eq=False)
class Given(Unfitted):
    """Scores that are given."""

    scores: F64
    name = "given"
    threshold = 0.0

    def score(self, batch: Batch[Any]) -> F64:
        return self.scores


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 100), levels=st.integers(2, 30))
def test_chances_rise_with_the_score_and_have_the_mean_of_the_labels(seed: int, levels: int) -> None:
    batch, rng = make_batch(seed), np.random.default_rng(seed)
    score = 100.0 * rng.integers(0, levels, len(batch))
    label = (rng.uniform(size=len(batch)) < score / (100 * levels)).astype(np.int64)
    clear = is_clear(batch)
    if len(set(label[clear])) < 2:
        return
    chances = calibrate(Given(score), [replace(batch, label=label)])
    at = chances(np.linspace(-1000, 100 * levels + 1000, 300))
    assert (np.diff(at) >= -1e-12).all() and at.min() >= 0 and at.max() <= 1


def test_two_scores_get_the_shares_of_good_ones_among_clear_candidates() -> None:
    batch = make_batch(1)
    clear = is_clear(batch)
    score = np.where(np.arange(len(batch)) % 2 == 0, 7.0, -3.0)
    k = np.arange(len(batch))
    label = np.where(score == 7, k % 3 > 0, k % 5 == 0).astype(np.int64)
    chances = calibrate(Given(score), [replace(batch, label=label)])
    for value in (-3.0, 7.0):
        share = label[clear & (score == value)].mean()
        assert chances(np.array([value]))[0] == pytest.approx(share)


def test_equal_labels_cannot_be_calibrated() -> None:
    batch = make_batch(0)
    with pytest.raises(InputError, match="labels are equal"):
        calibrate(Given(np.zeros(len(batch))), [replace(batch, label=np.ones_like(batch.label))])
