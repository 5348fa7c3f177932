"""Batches as torch's tensors on a model's device."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
import torch

from datagen.train.inputs import Array, Batch

T = TypeVar("T")


def to_torch(batch: Batch[Array], device: torch.device | str) -> Batch[torch.Tensor]:
    """The batch on the device. Text and `sample_id` stay numpy; on the CPU memory is shared."""
    extra = {name: a if a.dtype.kind in "OUS" else _tensor(a, device) for name, a in batch.extra.items()}
    return Batch(
        clouds=_moved(batch.clouds, device),
        robots=_moved(batch.robots, device),
        candidates=_moved(batch.candidates, device),
        label=_tensor(batch.label, device),
        sample_id=batch.sample_id,
        extra=extra,
    )


def _moved(table: Any, device: torch.device | str) -> Any:
    return replace(table, **{f.name: _tensor(getattr(table, f.name), device) for f in fields(table)})


def _tensor(values: Array, device: torch.device | str) -> torch.Tensor:
    # torch has few operations on unsigned integers of more than a byte.
    wide = values.astype(np.int64) if values.dtype.kind == "u" and values.dtype.itemsize > 1 else values
    return torch.from_numpy(np.ascontiguousarray(wide)).to(device)
