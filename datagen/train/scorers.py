"""Scorers of candidates, models or baselines: a score per candidate and a threshold."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, Array, Batch, is_clear

if TYPE_CHECKING:
    from datagen.train.models import Model


class Scorer(Protocol):
    """A method to evaluate: label 1 from `threshold` on; with nan, label 1 for each robot's best alone."""

    @property
    def name(self) -> str: ...

    @property
    def threshold(self) -> float: ...

    def score(self, batch: Batch[Array]) -> F64:
        """Scores (N,) of a batch's candidates; higher is better."""
        ...


@dataclass(frozen=True, eq=False)
class ModelScorer:
    """A model's probability of label 1; with `only_clear` 0 where the base is not clear.

    `robots` has the least and the largest sizes of the robots that it was trained on, where they are known;
    `side_deg` is the angle of the target from the front of their bases, None for a model that knows it.
    """

    model: Model
    name: str
    threshold: float = 0.5
    only_clear: bool = False
    robots: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    side_deg: float | None = 0.0

    def score(self, batch: Batch[Array]) -> F64:
        """Probabilities (N,); the model divides the candidates to bound memory.

        InputError where `only_clear` is set and the batch was read without `base_is_clear`.
        """
        import torch

        from datagen.train.tensors import to_torch

        trained = self.model.training
        self.model.eval()
        try:
            with torch.inference_mode():
                given = to_torch(batch, self.model.device)
                logits = self.model.score(given.clouds, given.candidates, given.robots).double()
                chance = torch.softmax(logits, dim=1)[:, 1].cpu().numpy()
        finally:
            self.model.train(trained)
        # NaN remains, also where the base is not clear.
        return np.where(is_clear(batch) | np.isnan(chance), chance, 0.0) if self.only_clear else chance


def scored(scorer: Scorer, batch: Batch[Array]) -> F64:
    """Scores (N,) of a batch. InputError names a sample whose score is missing or not a finite number."""
    score = np.asarray(scorer.score(batch), np.float64)
    if score.shape != (len(batch),) or not np.isfinite(score).all():
        row = int(np.argmin(np.isfinite(score))) if score.shape == (len(batch),) else 0
        problem = f"is not finite for sample {batch.sample_id[row].tobytes().hex()}"
        raise InputError(scorer.name, "score", problem, "Train the model again, or omit this method")
    return score


def weights_sha256(model: Model) -> str:
    """sha256 of a model's weights by name: the same for its checkpoint with and without optimiser's state."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        array = tensor.cpu().contiguous().numpy()
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
