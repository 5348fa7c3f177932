"""One observed scene for all tests of prediction."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from tests.train.prediction.seen_scenes import Seen, draw_seen, untrained_scorer
from train.scorers import ModelScorer


@pytest.fixture(scope="session")
def seen() -> Seen:
    """A scene of the built-in world in whose frame floor and target are seen."""
    return draw_seen(0)


@pytest.fixture(scope="session")
def scorer() -> ModelScorer:
    return untrained_scorer()


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Test processes share the cores: threads of one would wait for those of another."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
