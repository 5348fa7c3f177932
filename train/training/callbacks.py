"""Callbacks of the training loop: steps and epochs as they end, and their curves for TensorBoard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from datagen.schemas.errors import InputError
from datagen.workers.extras import how_to_get


@dataclass(frozen=True)
class TrainingStep:
    """One step of the optimiser, over all ranks."""

    step: int  # counted from 1
    steps: int  # of the whole schedule
    epoch: int  # counted from 1
    loss: float
    lr: float
    samples: int
    wait_s: float  # for the batch
    step_s: float  # all of it


class TrainingCallback(Protocol):
    """Called after each step and each epoch."""

    def step(self, step: TrainingStep) -> None: ...

    def epoch(self, record: dict[str, Any]) -> None:
        """A row of the history: epoch, loss, val_loss, val_accuracy, val_balanced_accuracy, val_auc, best."""
        ...


class CallbackList:
    """Several callbacks as one."""

    def __init__(self, callbacks: Sequence[TrainingCallback]) -> None:
        self._callbacks = tuple(callbacks)

    def step(self, step: TrainingStep) -> None:
        for callback in self._callbacks:
            callback.step(step)

    def epoch(self, record: dict[str, Any]) -> None:
        for callback in self._callbacks:
            callback.epoch(record)


class TensorBoardCallback:
    """Curves for TensorBoardCallback. A resumed training replaces those beyond `step`."""

    def __init__(self, folder: str, step: int = 0) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            fix = how_to_get("train")
            raise InputError("--tensorboard", "", "the package tensorboard is not installed", fix) from None
        self._writer = SummaryWriter(folder, purge_step=step + 1)
        self._step = step

    def step(self, step: TrainingStep) -> None:
        self._step = step.step
        for name, value in (("train/loss", step.loss), ("train/lr", step.lr)):
            self._writer.add_scalar(name, value, step.step)
        if step.step_s > 0:
            self._writer.add_scalar("speed/samples_per_s", step.samples / step.step_s, step.step)
            self._writer.add_scalar("speed/loader_share", step.wait_s / step.step_s, step.step)

    def epoch(self, record: dict[str, Any]) -> None:
        for name, value in record.items():
            if name.startswith("val_") and value is not None:
                self._writer.add_scalar(f"val/{name.removeprefix('val_')}", value, self._step)
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
