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
LEARNED = 0.005  # cross-entropy over the candidates


@pytest.mark.parametrize("name", sorted(MODELS))
def test_models_overfit_a_few_scenes(name: str, heuristic_run: Path):
    stream = SampleStream([heuristic_run], scenes_per_batch=3, shuffle=False)
    batch = to_torch(next(iter(stream.epoch(0))), "cpu")
    assert 0.1 < float(batch.label.float().mean()) < 0.9
    torch.manual_seed(0)
    model = build_model(name, SMALL[name])
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for step in range(STEPS):
        # A loss in training says nothing of how candidates are scored: n2m draws one of four frames for it.
        is_tried = step % 20 == 0 or step == STEPS - 1
        model.train(not is_tried)
        logits = model.score(batch.clouds, batch.candidates, batch.robots)
        loss = torch.nn.functional.cross_entropy(logits, batch.label)
        if is_tried and loss.item() < LEARNED:
            break
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    assert float((logits.argmax(1) == batch.label).double().mean()) > 0.99
