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
    extra = {name: _moved_column(a, device) for name, a in batch.extra.items()}
    return Batch(
        clouds=_moved(batch.clouds, device),
        robots=_moved(batch.robots, device),
        candidates=_moved(batch.candidates, device),
        label=_tensor(batch.label, device),
        sample_id=batch.sample_id,
        extra=extra,
    )


def on_cpu(table: Any) -> Any:
    """A table of tensors with numpy's arrays."""
    columns = {f.name: getattr(table, f.name) for f in fields(table)}
    return replace(table, **{k: a.cpu().numpy() for k, a in columns.items() if isinstance(a, torch.Tensor)})


def _moved(table: Any, device: torch.device | str) -> Any:
    columns = {f.name: getattr(table, f.name) for f in fields(table)}
    moved = {name: _moved_column(a, device) for name, a in columns.items() if a is not None}
    return replace(table, **moved)


def _moved_column(values: Array, device: torch.device | str) -> Any:
    return values if values.dtype.kind in "OUS" else _tensor(values, device)


def _tensor(values: Array, device: torch.device | str) -> torch.Tensor:
    # torch has few operations on unsigned integers of more than a byte.
    wide = values.astype(np.int64) if values.dtype.kind == "u" and values.dtype.itemsize > 1 else values
    return torch.from_numpy(np.ascontiguousarray(wide)).to(device)
