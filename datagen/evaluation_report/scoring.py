"""Score every candidate of the runs by every method, with progress."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.display.progress import counting
from datagen.evaluation_report.evaluated_runs import EvaluatedRun
from datagen.evaluation_report.methods import EvaluatedMethod
from datagen.train.evaluation.columns import Gathered, gather


def score_runs(
    runs: Sequence[EvaluatedRun],
    methods: Sequence[EvaluatedMethod],
    seed: int,
    json: bool,
    n_examples: int = 0,
) -> Gathered:
    """The columns of all runs in stored order, and `n_examples` scenes to show, drawn by `seed`."""
    with counting("scenes", json) as seen:
        total, done = sum(run.stream.n_scenes for run in runs), 0

        def step(scenes: int) -> None:
            nonlocal done
            done += scenes
            seen(done, total)

        batches = [(run.cells, run.stream.epoch(0)) for run in runs]
        rng = np.random.default_rng([seed, 0])
        return gather(batches, {m.name: m.scorer for m in methods}, rng, n_examples, step)
