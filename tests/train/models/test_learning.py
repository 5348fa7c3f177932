"""Both models learn a handful of scenes of a real run by heart, which needs every input and gradient."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from datagen.train.dataset import SampleStream
from datagen.train.models import MODELS, build_model
from datagen.train.tensors import to_torch
from tests.train.models.made_batches import SMALL

pytestmark = pytest.mark.slow

STEPS = 300


@pytest.mark.parametrize("name", sorted(MODELS))
def test_models_overfit_a_few_scenes(name: str, heuristic_run: Path):
    stream = SampleStream([heuristic_run], scenes_per_batch=3, shuffle=False)
    batch = to_torch(next(iter(stream.epoch(0))), "cpu")
    assert 0.1 < float(batch.label.float().mean()) < 0.9
    torch.manual_seed(0)
    model = build_model(name, SMALL[name])
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-3)
    for step in range(STEPS):
        model.train()
        logits = model.score(batch.clouds, batch.candidates, batch.robots)
        loss = torch.nn.functional.cross_entropy(logits, batch.label)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 20 == 19 and float(loss.detach()) < 0.005:
            break
    model.eval()
    with torch.no_grad():
        logits = model.score(batch.clouds, batch.candidates, batch.robots)
    assert float((logits.argmax(1) == batch.label).double().mean()) > 0.99
