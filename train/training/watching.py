"""What a training tells while it runs, and to whom: the loop knows this protocol alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from datagen.schemas.errors import InputError
from datagen.workers.extras import how_to_get


@dataclass(frozen=True)
class Step:
    """One step of the optimiser, over all ranks."""

    step: int  # counted from 1
    steps: int  # of the whole schedule
    epoch: int  # counted from 1
    loss: float
    lr: float
    samples: int
    wait_s: float  # for the batch
    step_s: float  # all of it


class Watcher(Protocol):
    """Is told of steps and epochs."""

    def step(self, step: Step) -> None: ...

    def epoch(self, record: dict[str, Any]) -> None:
        """A row of the history: epoch, loss, val_loss, val_accuracy, val_balanced_accuracy, val_auc, best."""
        ...


class Watchers:
    """Several as one."""

    def __init__(self, watchers: Sequence[Watcher]) -> None:
        self._watchers = tuple(watchers)

    def step(self, step: Step) -> None:
        for watcher in self._watchers:
            watcher.step(step)

    def epoch(self, record: dict[str, Any]) -> None:
        for watcher in self._watchers:
            watcher.epoch(record)


class TensorBoard:
    """Curves for TensorBoard. A training that goes on replaces what was drawn beyond `step`."""

    def __init__(self, folder: str, step: int = 0) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            mend = how_to_get("train")
            raise InputError("--tensorboard", "", "the package tensorboard is not installed", mend) from None
        self._writer = SummaryWriter(folder, purge_step=step + 1)
        self._step = step

    def step(self, step: Step) -> None:
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
