"""Learn from success rates: where trials were repeated, the loss is the binomial likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from datagen.schemas.fields import SCHEMAS
from datagen.train.inputs import Batch
from datagen.train.run_parts import RunPart

if TYPE_CHECKING:
    from torch import Tensor, dtype

RATE_FIELDS = ("trials", "successes")


def rate_fields(parts: Sequence[RunPart]) -> tuple[str, ...]:
    """`RATE_FIELDS` where a run repeats its trials and all runs hold them; else (), to use labels."""
    repeated = any(
        spec.arm is not None and (spec.arm.disturbance or spec.arm.draws)
        for part in parts
        for spec in part.specs
    )
    held = all(
        set(RATE_FIELDS) <= {field.name for field in SCHEMAS[part.schema].sample_fields} for part in parts
    )
    return RATE_FIELDS if repeated and held else ()


def label_losses(logits: Tensor, batch: Batch[Tensor]) -> Tensor:
    """Losses (N,) of logits (N, 2): cross-entropy with the label, or with the share of successful trials.

    The latter is the negative log-likelihood of a binomial number of successes, without its constant, for
    each trial. A candidate without a trial uses its label.
    """
    from torch.nn import functional

    if "trials" not in batch.extra:
        return functional.cross_entropy(logits, batch.label, reduction="none")
    rate = success_shares(batch, logits.dtype)
    log_p = functional.log_softmax(logits, dim=1)
    return -(rate * log_p[:, 1] + (1 - rate) * log_p[:, 0])


def success_shares(batch: Batch[Tensor], kind: dtype) -> Tensor:
    """Shares (N,) of successful trials; the label of candidates without a trial."""
    import torch

    label = batch.label.to(kind)
    if "trials" not in batch.extra:
        return label
    trials, successes = (batch.extra[name].to(kind) for name in RATE_FIELDS)
    return torch.where(trials > 0, successes / trials.clamp(min=1), label)
