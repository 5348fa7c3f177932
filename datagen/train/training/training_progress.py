"""Progress of the training loop: steps and epochs on the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from datagen.display.progress import Pace, Progress, clock_text, whole


@dataclass(frozen=True)
class TrainingStep:
    """One step of the optimiser."""

    step: int  # counted from 1
    steps: int  # in the whole schedule
    epoch: int  # counted from 1
    loss: float
    lr: float
    samples: int
    wait_s: float  # for the batch
    step_s: float  # for the whole step


class TrainingCallback(Protocol):
    """Called after each step and each epoch."""

    def step(self, step: TrainingStep) -> None: ...

    def epoch(self, record: dict[str, Any]) -> None:
        """A row of the history: epoch, loss, val_loss, val_accuracy, val_balanced_accuracy, val_auc, best."""
        ...


class TrainingProgress:
    """Progress of the training to `place`: loss, speed, time left, the loader's share; a row per epoch."""

    def __init__(self, shown: Progress, place: str) -> None:
        self._shown, self._place = shown, place
        self._spent_s = self._samples = self._waited_s = self._steps = 0.0
        self._pace = Pace(lambda: self._spent_s)

    def step(self, step: TrainingStep) -> None:
        self._spent_s, self._steps = self._spent_s + step.step_s, self._steps + 1
        self._samples, self._waited_s = self._samples + step.samples, self._waited_s + step.wait_s
        self._pace.see(self._samples, self._waited_s, self._steps)
        self._shown.update("steps", step.step, step.steps, lambda: self._figures(step))

    def epoch(self, record: dict[str, Any]) -> None:
        numbers = "".join(
            f"  {name} {record[field]:.4f}"
            for name, field in (("balanced", "val_balanced_accuracy"), ("AUC", "val_auc"))
            if record[field] is not None
        )
        text = (
            f"epoch {record['epoch']:3d}  loss {record['loss']:.4f}  validation {record['val_loss']:.4f}  "
            f"accuracy {record['val_accuracy']:.4f}{numbers}{'  best' if record['best'] else ''}"
        )
        self._shown.say("epoch", {"out": self._place, **record, **self._speed(4)}, text)

    def _speed(self, rate_digits: int) -> dict[str, float]:
        samples_per_s = round(self._pace.per_s(0), rate_digits)
        return {"samples_per_s": samples_per_s, "loader_share": round(self._pace.per_s(1), 4)}

    def _figures(self, step: TrainingStep) -> tuple[str, dict[str, object]]:
        speed, left_s = self._speed(1), self._pace.left_s(step.steps - step.step, 2)
        text = (
            f"loss {step.loss:.4f}  {speed['samples_per_s']:,.0f} samples/s  "
            f"{clock_text(left_s)} left  data {speed['loader_share']:.0%}"
        )
        values = {"epoch": step.epoch, "step": step.step, "steps": step.steps, "loss": round(step.loss, 5)}
        return text, {"out": self._place, **values, **speed, "left_s": whole(left_s)}
