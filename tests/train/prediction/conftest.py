"""One observed scene for all tests of prediction."""

from __future__ import annotations

import pytest

from datagen.train.scorers import ModelScorer
from tests.train.prediction.seen_scenes import Seen, draw_seen, untrained_scorer


@pytest.fixture(scope="session")
def seen() -> Seen:
    """A scene of the built-in world in whose frame floor and target are seen."""
    return draw_seen(0)


@pytest.fixture(scope="session")
def scorer() -> ModelScorer:
    return untrained_scorer()
