"""Several processes as one trainer: sums over them, and a model whose gradients they share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from datagen.train.models import Model


@dataclass(frozen=True)
class Ranks:
    """This process among `world` that train together. A world of 1 needs no process group."""

    rank: int = 0
    world: int = 1

    @property
    def leads(self) -> bool:
        """Whether it is this one that writes and shows."""
        return self.rank == 0

    def total(self, values: Tensor) -> Tensor:
        """Sums over all ranks, element by element."""
        if self.world > 1:
            dist.all_reduce(values)
        return values

    def gather(self, value: Any) -> list[Any]:
        """What every rank has, in order of ranks."""
        if self.world == 1:
            return [value]
        values: list[Any] = [None] * self.world
        dist.all_gather_object(values, value)
        return values

    def share_gradients(self, model: Model) -> Callable[..., Tensor]:
        """The model to call in training: gradients are the mean over ranks, parameters those of rank 0."""
        return DistributedDataParallel(model) if self.world > 1 else model

    def share_buffers(self, model: Model) -> None:
        """Let all have the running statistics of rank 0, which are those that are kept."""
        if self.world > 1:
            with torch.no_grad():
                for buffer in model.buffers():
                    dist.broadcast(buffer, 0)
