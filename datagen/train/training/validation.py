"""Validation of a model on scenes of other houses than it trains on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NotRequired

import numpy as np
import torch
from torch import Tensor
from typing_extensions import TypedDict  # pydantic reads typing's from Python 3.12 on

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, Array, Batch
from datagen.train.metrics import accuracy, area_under_roc, balanced_accuracy, confusion
from datagen.train.models import Model
from datagen.train.rates import label_losses, success_shares
from datagen.train.tensors import to_torch

# Candidates for the best temperature; 1 is among them.
_TEMPERATURES = 1.02 ** np.arange(-35, 71)


class ValidationMetrics(TypedDict):
    """Metrics of a model on samples; None where a metric is undefined with one class alone."""

    val_loss: float
    val_accuracy: float
    val_balanced_accuracy: float | None
    val_auc: float | None
    val_temperature: NotRequired[float]  # absent in the history of the released model


def validate(model: Model, batches: Iterable[Batch[Array]], class_weights: Tensor) -> ValidationMetrics:
    """Loss, accuracy, balanced accuracy and AUC; None where undefined.

    The temperature is the divisor of the logits, from 0.5 to 4, with the least loss (Guo et al. 2017,
    arXiv 1706.04599).
    """
    model.eval()
    columns: list[Array] = []
    with torch.inference_mode():
        for batch in batches:
            given = to_torch(batch, model.device)
            logits = model.score(given.clouds, given.candidates, given.robots).double()
            log_p = torch.log_softmax(logits, dim=1)
            loss = label_losses(logits, given)
            share, log_odds = success_shares(given, logits.dtype), logits[:, 1] - logits[:, 0]
            rows = torch.stack([given.label.double(), log_p[:, 1].exp(), loss, share, log_odds], dim=1)
            columns.append(rows.cpu().numpy())
    model.train()
    label, p, loss, share, log_odds = np.concatenate(columns).T
    weight = class_weights.cpu().double().numpy()[label.astype(np.int64)]
    mean_loss = float(np.average(loss, weights=weight))
    if not np.isfinite(mean_loss):
        fix = "Train again with a smaller --lr, or look at the samples with `datagen verify`"
        raise InputError("validation", "loss", f"{mean_loss} over {len(loss)} samples", fix)
    counts = confusion((p >= 0.5).astype(np.float64), label == 1, np.zeros(len(p), np.int64), 1)[0]
    balanced, auc = float(balanced_accuracy(counts)), area_under_roc(label == 1, p)
    return {
        "val_loss": mean_loss,
        "val_accuracy": float(accuracy(counts)),
        "val_balanced_accuracy": balanced if np.isfinite(balanced) else None,
        "val_auc": auc if np.isfinite(auc) else None,
        "val_temperature": _best_temperature(log_odds, share, weight),
    }


def _best_temperature(log_odds: F64, share: F64, weight: F64) -> float:
    """The temperature with the least mean loss; log-odds and shares of successes are (N,) each."""
    cooled = log_odds / _TEMPERATURES[:, None]
    losses = np.logaddexp(0, cooled) - share * cooled
    return float(_TEMPERATURES[np.average(losses, axis=1, weights=weight).argmin()])
