"""One observed scene for all tests of prediction."""

from __future__ import annotations

import pytest
import torch

from datagen.train.models import build_model
from datagen.train.scorers import ModelScorer
from tests.train.prediction.seen_scenes import MODEL, Seen, draw_seen


@pytest.fixture(scope="session")
def seen() -> Seen:
    """A scene of the built-in world in whose frame floor and target are seen."""
    return draw_seen(0)


@pytest.fixture(scope="session")
def scorer() -> ModelScorer:
    """A small model with the same parameters each time: it looks at cloud, robot and place."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        return ModelScorer(build_model("shared", MODEL).eval(), "untrained", threshold=0.0)
