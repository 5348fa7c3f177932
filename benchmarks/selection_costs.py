"""CPU seconds of labels of selected candidates: timed by outcome, and scaled to the ledger of a run."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.repeatability import Labelling, label_scene, stored_scenes
from datagen.display.progress import counting
from datagen.schemas.outcomes import OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_committed
from datagen.schemas.whole_files import whole_file
from datagen.train.encoded.runs import encoded_stream
from datagen.train.inputs import F64, I64, Array
from datagen.train.models.shared import SharedModel
from datagen.train.scorers import ModelScorer
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from datagen.workers.world import open_world

# Kinds of outcomes that differ in their cost; the rest are the last kind.
KINDS = ("success", "out_of_reach", "no_ik", "arm_collision", "other")
_MAKING = ("draw", "settle", "observe")  # stages that make a scene, or make it again


@dataclass(frozen=True)
class Costs:
    """CPU seconds of labels."""

    new_scene_s: float
    scene_again_s: float
    prepared_scene_s: float  # grasps and robots in a scene, however many candidates are planned
    candidate_s: tuple[float, ...]  # by kind of outcome
    scored_scene_s: float

    def labels_s(self, kinds: Array, scenes: int, again: bool) -> float:
        """CPU seconds of labels of candidates of these kinds (n,) in N scenes."""
        a_scene = self.prepared_scene_s + (self.scene_again_s if again else self.new_scene_s)
        return float(scenes * a_scene + np.array(self.candidate_s)[kinds].sum())


def kinds_of(outcome: Array) -> I64:
    """Row in KINDS (N,) of stored outcomes."""
    table = [KINDS.index(name) if name in KINDS else len(KINDS) - 1 for name in OUTCOMES]
    return np.array(table)[outcome.astype(np.int64)]


def measured_costs(
    train: Run, selected: Run, houses: str, objects: str, n_scenes: int, model: SharedModel, file: Path
) -> Costs:
    """The costs in `file`, or measured over scenes of TRAIN and written to it.

    Seconds of making a scene, new or again, are those of the ledgers of TRAIN and SELECTED. Labelling is
    timed, and scaled to the cost of TRAIN in its ledger: a busy machine takes more CPU seconds.
    """
    if not file.exists():
        timed = _timed(train, houses, objects, n_scenes)
        kinds = kinds_of(np.array([list(OUTCOMES).index(name) for name in timed.outcomes]))
        spent = np.array(timed.plan_s)
        candidate_s = np.array([spent[kinds == k].mean() for k in range(len(KINDS))])
        prepared_s = timed.prepare_s / n_scenes
        ledger, others = _ledger(train), _ledger(selected)
        scale = ledger[1] / (ledger[2] * prepared_s + ledger[3:] @ candidate_s)
        costs = Costs(
            ledger[0] / ledger[2],
            others[0] / others[2],
            scale * prepared_s,
            tuple((scale * candidate_s).tolist()),
            _scoring_s(model, train, n_scenes),
        )
        with whole_file(file) as written:
            written.write(json.dumps({"scale": scale, "costs": asdict(costs)}).encode())
    stored = json.loads(file.read_bytes())
    costs = Costs(**stored["costs"])
    _print(costs, stored["scale"])
    return costs


def _timed(run: Run, houses: str, objects: str, n_scenes: int) -> Labelling:
    """Plan all candidates of the run's first scenes again."""
    labelling = Labelling("timed", run.manifest.spec, 0)
    world = open_world(run.manifest.spec, houses, objects)
    with counting("scenes timed", False) as seen:
        for done, (_, stored) in enumerate(stored_scenes(run, n_scenes)):
            scene = reconstruct_scene(world, stored.record)
            candidates = reconstruct_candidates(stored.samples, scene)
            label_scene(labelling, scene, candidates, range(len(stored.samples["outcome"])))
            seen(done + 1, n_scenes)
    return labelling


def _scoring_s(model: SharedModel, run: Run, n_scenes: int) -> float:
    """Seconds a scene of `submit --select`: read its cloud, encode it, score its candidates."""
    scorer, scenes = ModelScorer(model.eval(), "first"), 0
    began = time.process_time()
    for batch in encoded_stream([run.storage.url], False).epoch(0):
        scorer.score(batch)
        scenes += len(batch.clouds)
        if scenes >= n_scenes:
            break
    return (time.process_time() - began) / scenes


def _ledger(run: Run) -> F64:
    """Seconds of making scenes and of labelling them; scenes, then candidates by kind."""
    found = np.zeros(3 + len(KINDS))
    for shard in sorted(run.committed()):
        commit = run.commit_of(shard)
        making = sum(commit.cost.stage_cpu_s.get(stage, 0.0) for stage in _MAKING)
        outcome = read_committed(run.storage, commit, ("outcome",))["outcome"]
        counts = np.bincount(kinds_of(outcome), minlength=len(KINDS))
        found += [making, commit.cost.cpu_s - making, commit.scenes, *counts.tolist()]
    return found


def _print(costs: Costs, scale: float) -> None:
    print("CPU ms of")
    named = [
        ("a new scene", costs.new_scene_s),
        ("a stored scene, made again", costs.scene_again_s),
        ("grasps and robots in a scene", costs.prepared_scene_s),
        *((f"a candidate, {kind}", s) for kind, s in zip(KINDS, costs.candidate_s, strict=True)),
        ("scoring a scene of the pool", costs.scored_scene_s),
    ]
    for name, seconds in named:
        print(f"  {name:<42}{1000 * seconds:8.1f}")
    print(f"labelling was timed, and multiplied by {scale:.2f} to cost what TRAIN's ledger says")
