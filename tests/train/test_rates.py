"""The loss on rates: the binomial likelihood, equal to the cross-entropy where trials agree with labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.special import comb
from torch import Tensor

from datagen.train.inputs import Batch
from datagen.train.rates import label_losses
from tests.train.models.made_batches import drawn_tables


def batch_of(trials: list[int], successes: list[int]) -> Batch[Tensor]:
    """Candidates with the label 1 and these counts."""
    clouds, candidates, robots = drawn_tables(candidates=len(trials))
    extra = {"trials": torch.tensor(trials), "successes": torch.tensor(successes)}
    ids = np.zeros((len(trials), 16), np.uint8)
    return Batch(clouds, robots, candidates, torch.ones(len(trials), dtype=torch.int64), ids, extra)


def test_the_loss_is_the_binomial_likelihood() -> None:
    batch = batch_of([5, 4], [2, 0])
    logits = torch.randn(len(batch.label), 2, generator=torch.Generator().manual_seed(0)).double()
    losses = label_losses(logits, batch)
    p = torch.softmax(logits, dim=1)[:, 1].numpy()
    for row, (n, k) in enumerate([(5, 2), (4, 0)]):
        likelihood = stats.binom.logpmf(k, n, p[row]) - np.log(comb(n, k))
        assert losses[row].item() * n == pytest.approx(-likelihood, abs=1e-9)


def test_trials_that_agree_with_labels_and_none_at_all_change_nothing() -> None:
    batch = batch_of([3, 0], [3, 0])
    logits = torch.randn(len(batch.label), 2, generator=torch.Generator().manual_seed(1))
    plain = label_losses(logits, replace(batch, extra={}))
    torch.testing.assert_close(label_losses(logits, batch), plain)
