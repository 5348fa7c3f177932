"""Shards of `sim` whose trials misbehave as told: real attempts, with a fault inside their first trial."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import datagen.workers.labels.arm_labelling as label_trials
from datagen.cluster.attempt import run_attempt
from datagen.cluster.attempt_guard import Meter
from datagen.cluster.protocol import AttemptResult, ShardTask
from tests.faults.scripted import misbehave


@dataclass(frozen=True)
class FaultyTrials(ShardTask):
    """The n-th attempt does the n-th word in its first trial, and has none when there is no more."""

    words: tuple[str, ...] = ()


def attempt_with_faults(task: FaultyTrials, meter: Meter) -> AttemptResult:
    """The task function. Attempts are counted by files beside the notes."""
    tries = Path(task.notes).parent / "tries"
    tries.mkdir(exist_ok=True)
    n = len(list(tries.glob(f"{task.shard}-*")))
    (tries / f"{task.shard}-{n}").touch()
    real = label_trials.run_trial

    def faulty(*arguments: Any) -> Any:
        misbehave(task.words[n] if n < len(task.words) else "")
        return real(*arguments)

    label_trials.run_trial = faulty
    try:
        return run_attempt(task, meter)
    finally:
        label_trials.run_trial = real
