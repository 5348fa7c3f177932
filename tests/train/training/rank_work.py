"""What the processes of a test do; new processes import it by name."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datagen.schemas.errors import InputError
from datagen.train.inputs import Array, Batch, CandidateInputs, Clouds, RobotInputs
from datagen.train.training.launching import Ranks
from datagen.train.training.loop import run_training
from datagen.train.training.training_setup import TrainingJob, prepare_training, save_checkpoint


def train_and_save_results(job: TrainingJob, ranks: Ranks, stopping: Callable[[], bool]) -> bool:
    """Train, and leave this rank's weights and samples beside the checkpoint.

    Then the second rank refuses something while the first still waits for it.
    """
    torch.set_num_threads(1)
    training, head = prepare_training(job, ranks)
    assert run_training(training, lambda: save_checkpoint(job.out, training, head), stopping=stopping)
    samples = [batch.sample_id for batch in training.train.epoch(0)]
    told = {"weights": training.model.state_dict(), "ids": torch.from_numpy(np.concatenate(samples))}
    torch.save(told, f"{job.out}.{ranks.rank}")
    ranks.gather("told")
    if ranks.rank == 1:
        raise InputError("place", "field", "problem", "Fix it")
    ranks.gather("never answered")
    return True


def wait_for_stop(job: str, ranks: Ranks, stopping: Callable[[], bool]) -> bool:
    """Say by the job's file that this rank is there, and wait."""
    Path(job).touch()
    while not stopping():
        time.sleep(0.05)
    return True


class Union:
    """The batches of several ranks as one, step by step."""

    def __init__(self, streams: list[Any]) -> None:
        self._streams = streams
        self.batches_per_epoch: int = streams[0].batches_per_epoch

    def epoch(self, k: int, skip_batches: int = 0) -> Iterator[Batch[Array]]:
        epochs = [stream.epoch(k, skip_batches) for stream in self._streams]
        for parts in zip(*epochs, strict=True):
            yield joined(list(parts))


def joined(parts: list[Batch[Array]]) -> Batch[Array]:
    clouds = np.cumsum([0, *(len(p.clouds) for p in parts)])
    robots = np.cumsum([0, *(len(p.robots) for p in parts)])
    rows = {
        "cloud_row": np.concatenate(
            [p.robots.cloud_row + n for p, n in zip(parts, clouds[:-1], strict=True)]
        ),
        "robot_row": np.concatenate(
            [p.candidates.robot_row + n for p, n in zip(parts, robots[:-1], strict=True)]
        ),
    }

    def table(kind: Any, name: str) -> Any:
        tables = [getattr(p, name) for p in parts]
        columns = {
            f.name: np.concatenate([getattr(t, f.name) for t in tables]) for f in dataclasses.fields(kind)
        }
        return kind(**{**columns, **{k: v for k, v in rows.items() if k in columns}})

    return Batch(
        clouds=table(Clouds, "clouds"),
        robots=table(RobotInputs, "robots"),
        candidates=table(CandidateInputs, "candidates"),
        label=np.concatenate([p.label for p in parts]),
        sample_id=np.concatenate([p.sample_id for p in parts]),
    )


def results_of(out: Path | str, rank: int) -> dict[str, Any]:
    return torch.load(f"{out}.{rank}", weights_only=True)
