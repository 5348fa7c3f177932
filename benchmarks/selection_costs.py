"""CPU seconds of labels of selected candidates, fitted to the ledgers of runs."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from datagen.schemas.outcomes import OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_committed
from datagen.train.encoded.runs import encoded_stream
from datagen.train.inputs import F64, I64, Array
from datagen.train.models.shared import SharedModel
from datagen.train.scorers import ModelScorer

# Kinds of outcomes that differ in their cost; the rest are the last kind.
KINDS = ("success", "out_of_reach", "no_ik", "arm_collision", "other")
_MAKING = ("draw", "settle", "observe")  # stages that make a scene, or make it again
_TIMED_SCENES = 64


@dataclass(frozen=True)
class Costs:
    """CPU seconds of labels."""

    new_scene_s: float
    scene_again_s: float
    labelled_scene_s: float  # of labelling, however many candidates it has
    candidate_s: F64  # by kind of outcome
    scored_scene_s: float

    def labels_s(self, kinds: Array, scenes: int, again: bool) -> float:
        """Of candidates of these kinds (n,) in some scenes."""
        a_scene = self.labelled_scene_s + (self.scene_again_s if again else self.new_scene_s)
        return float(scenes * a_scene + self.candidate_s[kinds].sum())


def kinds_of(outcome: Array) -> I64:
    """Row in KINDS (N,) of stored outcomes."""
    table = [KINDS.index(name) if name in KINDS else len(KINDS) - 1 for name in OUTCOMES]
    return np.array(table)[outcome.astype(np.int64)]


def scoring_s(model: SharedModel, place: str) -> float:
    """Seconds a scene of `submit --select`: read its cloud, encode it, score its candidates."""
    scorer, scenes = ModelScorer(model.eval(), "first"), 0
    began = time.process_time()
    for batch in encoded_stream([place], False).epoch(0):
        scorer.score(batch)
        scenes += len(batch.clouds)
        if scenes >= _TIMED_SCENES:
            break
    return (time.process_time() - began) / scenes


def fitted_costs(train: Run, selected: Run, scored_scene_s: float) -> Costs:
    """Fit the seconds of labelling to the shards of both runs; TRAIN's scenes are new, SELECTED's made again.

    Both are printed, with what the runs recorded.
    """
    of_runs = {run.storage.url: _shards(run) for run in (train, selected)}
    shards = np.concatenate(list(of_runs.values()))
    fitted = nnls(shards[:, 2:], shards[:, 0])[0]
    new, again = (float(rows[:, 1].sum() / rows[:, 2].sum()) for rows in of_runs.values())
    costs = Costs(new, again, float(fitted[0]), fitted[1:], scored_scene_s)
    print("CPU ms of")
    named = [("a new scene", new), ("a stored scene, made again", again), ("labelling, a scene", fitted[0])]
    named += [(f"labelling, a candidate, {k}", s) for k, s in zip(KINDS, fitted[1:].tolist(), strict=True)]
    for name, seconds in [*named, ("scoring a scene of the pool", scored_scene_s)]:
        print(f"  {name:<42}{1000 * seconds:8.1f}")
    for url, rows in of_runs.items():
        recorded, by_fit = rows[:, 0].sum(), (rows[:, 2:] @ fitted).sum()
        print(f"labelling of {url}: {recorded:.0f} s recorded, {by_fit:.0f} s fitted")
    return costs


def _shards(run: Run) -> F64:
    """Of each shard: seconds of labelling, seconds of making scenes, scenes, and candidates by kind."""
    rows: list[list[float]] = []
    for shard in sorted(run.committed()):
        commit = run.commit_of(shard)
        making = sum(commit.cost.stage_cpu_s.get(stage, 0.0) for stage in _MAKING)
        outcome = read_committed(run.storage, commit, ("outcome",))["outcome"]
        counts = np.bincount(kinds_of(outcome), minlength=len(KINDS))
        rows.append([commit.cost.cpu_s - making, making, commit.scenes, *counts.tolist()])
    return np.array(rows)
