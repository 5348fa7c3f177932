"""What validation measures, over known logits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.train.inputs import I64, Array, Batch, CandidateInputs, Clouds, RobotInputs
from datagen.train.models import Model
from datagen.train.models.model import ModelConfig
from datagen.train.training.checkpoints import read_checkpoint
from datagen.train.training.validation import validate
from tests.train.training.small import job_of, train_until


class Told(Model):
    """Has the logits that it was given, in the order of the candidates."""

    name = "told"

    def __init__(self, logits: Array) -> None:
        super().__init__(ModelConfig())
        self.given = torch.nn.Parameter(torch.from_numpy(np.stack([0 * logits, logits], axis=1)).float())

    def forward(self, clouds: object, candidates: object, robots: object) -> torch.Tensor:
        return self.given


def batch_of(label: I64) -> Batch[Array]:
    """One cloud without points, one robot, and a candidate for each label."""
    n, one = len(label), np.ones(1, np.float32)
    empty = np.zeros((1, 0, 3), np.float32)
    return Batch(
        Clouds(empty, empty.astype(np.uint8), empty[..., 0] > 0, np.zeros(1, np.int64), one, one),
        RobotInputs(np.zeros(1, np.int64), one, one, one),
        CandidateInputs(np.zeros(n, np.int64), np.zeros((n, 2), np.float32)),
        label,
        np.arange(n, dtype="<i8").view(np.uint8).reshape(n, 8).repeat(2, axis=1),
    )


@pytest.mark.parametrize("too_sure", [0.7, 1.0, 1.6, 3.0])
def test_the_temperature_makes_chances_true(too_sure: float):
    rng = np.random.default_rng(1)
    logits = rng.normal(0, 2, 40_000)
    label = (rng.random(len(logits)) < 1 / (1 + np.exp(-logits))).astype(np.int64)
    found = validate(Told(too_sure * logits), [batch_of(label)], torch.ones(2))
    assert found.get("val_temperature") == pytest.approx(too_sure, rel=0.05)
    exact = np.logaddexp(0, -(2 * label - 1) * too_sure * logits).mean()
    assert found["val_loss"] == pytest.approx(exact, rel=1e-5)
    assert found["val_accuracy"] == pytest.approx(((logits >= 0) == label).mean())


def test_a_checkpoint_has_the_weights_of_its_best_epoch_at_their_temperature(
    heuristic_run: Path, tmp_path: Path
):
    job = job_of(heuristic_run, tmp_path / "c.ckpt", epochs=1, lr=0.05)
    assert train_until(job)[0]
    made = read_checkpoint(job.out)
    (epoch,) = made.head.history
    last = {name.removeprefix("model."): t for name, t in made.resume.items() if name.startswith("model.")}
    scaled = {name for name in last if not torch.equal(last[name], made.weights[name])}
    temperature = epoch.get("val_temperature", 1.0)
    assert temperature != 1
    assert scaled == {"head.3.3.weight", "head.3.3.bias"}
    for name in scaled:
        torch.testing.assert_close(made.weights[name], last[name] / temperature)
