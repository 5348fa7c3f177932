"""One training of a shared model from encoded runs, and its scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.train.encoded.batches import EncodedBatches
from datagen.train.encoded.runs import EncodedRuns
from datagen.train.inputs import F32, I64
from datagen.train.models import Model, build_model
from datagen.train.tensors import to_torch
from datagen.train.training.checkpoints import EpochRecord, put_weights
from datagen.train.training.launching import Ranks
from datagen.train.training.loop import Position, Training, run_training
from datagen.train.training.optimiser import make_optimiser
from datagen.train.training.options import STAGES, Options

_SCENES_PER_BATCH = 32


@dataclass(frozen=True, eq=False)
class Trained:
    """A model with its best weights, and the history and cost of its training."""

    model: Model
    best_epoch: int  # counted from 1
    history: tuple[EpochRecord, ...]
    cost: Mapping[str, float]  # train_wall_s, train_cpu_s, data_wait_s


def train_encoded(
    options: Options,
    train: EncodedBatches,
    val: EncodedBatches,
    init: Mapping[str, Tensor] | None,
    stopping: Callable[[], bool],
) -> Trained | None:
    """Train as `datagen train` does, on the CPU; None if it was stopped. `init` are the first weights."""
    torch.manual_seed(options.seed)
    model = build_model(options.model, options.model_config)
    if init is not None:
        put_weights(model, dict(init), "weights to begin from")
    position = Position()
    training = Training(
        options,
        model,
        make_optimiser(model, options.lr, options.weight_decay),
        train,
        val,
        _class_weights(train, STAGES[options.stage].weighted),
        position,
        Ranks(),
    )
    # A training takes a minute, so a stopped one is not saved.
    if not run_training(training, lambda: None, stopping=stopping):
        return None
    assert position.best_epoch is not None
    model.load_state_dict(position.best_weights)
    return Trained(model.eval(), position.best_epoch, tuple(position.history), position.cost)


def _class_weights(train: EncodedBatches, weighted: bool) -> Tensor:
    """Weights (2,) that balance the classes; ones where unweighted, or where a class is missing."""
    counts = np.array(train.class_counts(), np.float64)
    weights = counts.sum() / (2 * counts) if weighted and counts.all() else np.ones(2)
    return torch.from_numpy(weights.astype(np.float32))


def scores_of(model: Model, encoded: EncodedRuns, scenes: I64 | None = None) -> F32:
    """Probabilities (N,) of label 1 of the candidates of these scenes [all], in their order."""
    chosen = np.arange(len(encoded.houses)) if scenes is None else scenes
    batches = EncodedBatches(encoded, chosen, _SCENES_PER_BATCH)
    found: list[Any] = []
    with torch.inference_mode():
        for batch in batches.epoch(0):
            given = to_torch(batch, "cpu")
            logits = model.score(given.clouds, given.candidates, given.robots).double()
            found.append(torch.softmax(logits, dim=1)[:, 1].float().numpy())
    return np.concatenate(found)
