"""Small trainings on the runs of tests: tiny models, a step of some scenes, one thread."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from datagen.train.training.loop import TrainingProgress, TrainingStep, run_training
from datagen.train.training.options import Options
from datagen.train.training.training_setup import TrainingJob, prepare_training, save_checkpoint

TINY: dict[str, Any] = {
    "n_points": 64,
    "tokens": [4, 4, 4],
    "scales_m": [0.1],
    "width": 4,
    "embedding": 8,
    "head": [8],
    "dropout": 0.25,
}
TINY_PAPER: dict[str, Any] = {
    "n_points": 64,
    "centroids": [8, 4],
    "neighbours": [4, 4],
    "widths": [[8], [8], [8]],
    "head": [8],
}


def job_of(runs: Path, out: Path, **changes: Any) -> TrainingJob:
    fields = {"stage": "stage1", "model": "shared", "model_config": TINY, "epochs": 2, "batch_scenes": 4}
    return TrainingJob(Options(**{**fields, **changes}), (str(runs),), (), str(out))


class Recorder(TrainingProgress):
    """Keeps all steps and epochs."""

    def __init__(self) -> None:
        self.steps: list[TrainingStep] = []
        self.epochs: list[dict[str, Any]] = []

    def step(self, step: TrainingStep) -> None:
        self.steps.append(step)

    def epoch(self, record: dict[str, Any]) -> None:
        self.epochs.append(record)


def train_until(job: TrainingJob, step: int | None = None) -> tuple[bool, Recorder]:
    """Resume a job until it ends or Ctrl-C comes during the given step."""
    training, head = prepare_training(job)
    seen = Recorder()

    def stopping() -> bool:
        return step is not None and training.position.step + 1 >= step

    done = run_training(training, lambda: save_checkpoint(job.out, training, head), [seen], stopping)
    return done, seen


def equal(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> bool:
    """Same names and, bit for bit, the same numbers."""
    return a.keys() == b.keys() and all(
        a[k].dtype == b[k].dtype and a[k].numpy().tobytes() == b[k].numpy().tobytes() for k in a
    )
