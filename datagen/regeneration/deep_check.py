"""Deep checks of a run: samples recomputed from stored poses, scenes sampled again from their seeds.

Digests show that bytes are unchanged; these checks show that they follow from the specification.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

import numpy as np

from datagen.regeneration.scenes import OpenedSources, Replayer, chosen_rows, open_replayer, what_differs_here
from datagen.regeneration.stage_comparison import (
    DRAWN,
    RECOMPUTED,
    STAGES,
    StageComparison,
    beyond_tolerance,
    compare_stages,
)
from datagen.schemas.checking.finding import Finding
from datagen.schemas.errors import InputError
from datagen.schemas.keys import shard_folder
from datagen.schemas.run import Run
from datagen.schemas.scene_rows import read_scenes

_RECOMPUTED = "recomputed from stored poses"
_FIX = "Do not use this run; find the cause in its code version, libraries or machine"
# Candidates of a scene to label again where a label is a plan or a trial.
_TRIED = 4


def deep_findings(run: Run, k: int, origin: OpenedSources, rng: np.random.Generator) -> Iterator[Finding]:
    """Yield findings on k random committed samples and k random committed scenes of a run.

    Samples are recomputed from their stored poses, scenes are sampled again from their seeds. Where machine
    and versions are those that made them, they must be equal bit for bit. Elsewhere samples must be within
    the stated tolerances, and scenes equal in all that is sampled before any physics
    (docs/explanation/determinism.md). Scenes of another run that no longer exists are not sampled again.
    Reads at most 2 k shards, one at a time. Keys of the findings are relative to the run's folder.
    """
    shards = sorted(run.committed())
    if not shards or k < 1:
        return
    replayer = open_replayer(run, origin)
    per_shard, per_scene = run.layout.samples_per_shard, run.layout.candidates_per_scene
    of_shard = rng.choice(len(shards), k)
    within = rng.integers(per_shard, size=k)
    indices = sorted(
        {(shards[s] * per_shard + i) for s, i in zip(of_shard.tolist(), within.tolist(), strict=True)}
    )
    for scene, group in groupby(indices, key=lambda i: i // per_scene):
        yield from _checked(run, scene, _sample_findings(replayer, scene, [i % per_scene for i in group]))
    if replayer.sampling_world is None:
        return
    of_shard = rng.choice(len(shards), k)
    within = rng.integers(run.layout.scenes_per_shard, size=k)
    scenes = {
        shards[s] * run.layout.scenes_per_shard + i
        for s, i in zip(of_shard.tolist(), within.tolist(), strict=True)
    }
    for scene in sorted(scenes):
        count = per_scene if run.manifest.spec.arm is None else min(_TRIED, per_scene)
        rows = sorted(rng.choice(per_scene, count, replace=False).tolist())
        yield from _checked(run, scene, _scene_findings(replayer, scene, rows))


def _checked(run: Run, scene: int, findings: Iterator[Finding]) -> Iterator[Finding]:
    """Yield the findings; an InputError on the stored rows is one of them."""
    try:
        yield from findings
    except InputError as error:
        key, problem = str(error.place).removeprefix(f"{run.storage.url}/"), f"scene {scene}: {error.problem}"
        yield Finding(key, "deep", problem, _FIX, scene // run.layout.scenes_per_shard)


def _sample_findings(replayer: Replayer, scene: int, rows: list[int]) -> Iterator[Finding]:
    run, stages = replayer.run, RECOMPUTED
    stored = next(read_scenes(run, [scene]))
    made, kept = replayer.recompute(stored, rows), chosen_rows(stored, rows)
    if what_differs_here(run, scene // run.layout.scenes_per_shard):
        stages = ("candidates",)
        if problems := beyond_tolerance(run.manifest.spec, kept.samples, made.samples):
            yield _finding(run, scene, f"{_RECOMPUTED}: {'; '.join(problems)}")
    yield from _of_stages(run, scene, compare_stages(run.schema, kept, made, stages), _RECOMPUTED)


def _scene_findings(replayer: Replayer, scene: int, rows: list[int]) -> Iterator[Finding]:
    run, stages = replayer.run, tuple(STAGES)
    stored = next(read_scenes(run, [scene]))
    kept = chosen_rows(stored, rows)
    made = replayer.sample_again(int(stored.record["scene_index"]), kept.samples["candidate_index"].tolist())
    if what_differs_here(run, scene // run.layout.scenes_per_shard):
        # Other physics results may cause a resampling, after which all draws differ.
        stages = DRAWN[:1] if int(made.record["retry"]) == int(stored.record["retry"]) else ()
    yield from _of_stages(run, scene, compare_stages(run.schema, kept, made, stages), "sampled again")


def _of_stages(run: Run, scene: int, stages: list[StageComparison], how: str) -> Iterator[Finding]:
    different = [stage for stage in stages if not stage.equal]
    if different:
        # Later stages follow from the first that differs.
        first = different[0]
        text = "; ".join(str(d) for d in first.differences)
        yield _finding(run, scene, f"{how}: {first.stage}: {text}", first.differences[0].field)


def _finding(run: Run, scene: int, problem: str, field: str = "label") -> Finding:
    shard = scene // run.layout.scenes_per_shard
    folder = shard_folder(shard, run.commit_of(shard).attempt)
    return Finding(f"{folder}/{field}", "deep", f"scene {scene}, {problem}", _FIX, shard)
