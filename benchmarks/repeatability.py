"""Labels of the same candidates under other random numbers: for grasps, seeds of IK and paths.

    python -m benchmarks.repeatability RUN [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 60]

RUN is a run of `plan` or `sim`. Its scenes and candidates are labelled by `plan` with draw 0, as in runs, and
with --draws others. The output is the share of labels that differ, of all candidates within reach and of
those that are negative by draw 0, by outcome, with 95% intervals by bootstrap over scenes; then the CPU time
of planning by outcome.

    --set arm.grasps.per_object=600        compare also with other parameters, under draw 0
    --per-object                           also by object
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.configuration.specify import put_field
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.shard_reading import read_scenes
from datagen.schemas.specification import Specification
from datagen.train.bootstrap import resample_weights
from datagen.workers.bases.candidates import SceneCandidates, distances
from datagen.workers.labels.arm_labelling import ArmInScene, arm_in_scene, try_candidate
from datagen.workers.scenes import SettledScene
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from datagen.workers.world import open_world

_RESAMPLES = 2000


@dataclass
class Labelling:
    """The outcomes of one way to label, in the order of the candidates."""

    name: str
    spec: Specification
    draw: int
    outcomes: list[str] = field(default_factory=list)
    plan_s: list[float] = field(default_factory=list)  # CPU
    prepare_s: float = 0.0
    grasps_free: list[int] = field(default_factory=list)
    grasps_tried: list[int] = field(default_factory=list)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", metavar="RUN")
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--draws", type=int, default=1, help="other draws to compare with draw 0")
    parser.add_argument(
        "--base", action="append", default=[], metavar="FIELD=VALUE", help="of all labellings"
    )
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE[,FIELD=VALUE]")
    parser.add_argument("--per-object", action="store_true")
    options = parser.parse_args()
    run = Run.open(options.run)
    base = _plan_spec(changed(run.manifest.spec, options.base))
    labellings = [Labelling("draw 0", base, 0)]
    labellings += [Labelling(f"draw {draw}", base, draw) for draw in range(1, options.draws + 1)]
    labellings += [Labelling(text, changed(base, text.split(",")), 0) for text in options.set]
    world = open_world(run.manifest.spec, options.houses, options.objects)
    scene_of: list[int] = []
    target_of: list[str] = []
    for number, stored in stored_scenes(run, options.scenes):
        scene = reconstruct_scene(world, stored.record)
        candidates = reconstruct_candidates(stored.samples, scene)
        rows = within_reach(scene, candidates)
        scene_of += [number] * len(rows)
        target_of += [scene.models[0].name] * len(rows)
        for labelling in labellings:
            label_scene(labelling, scene, candidates, rows)
        print(f"scene {number}", file=sys.stderr, flush=True)
    counts = f"{len(set(scene_of))} scenes, {len(set(target_of))} targets"
    print(f"{len(scene_of)} candidates within reach of {counts}")
    scenes = np.array(scene_of)
    for labelling in labellings[1:]:
        print_flips(labellings[0], labelling, scenes)
        if options.per_object:
            print_by_target(labellings[0], labelling, target_of)
    for labelling in labellings:
        print_cost(labelling)


def stored_scenes(run: Run, count: int) -> Iterator[tuple[int, SceneRows]]:
    """The first `count` scenes of committed shards, with their numbers."""
    each = run.layout.scenes_per_shard
    numbers = [shard * each + k for shard in sorted(run.committed()) for k in range(each)][:count]
    return zip(numbers, read_scenes(run, numbers), strict=True)


def changed(spec: Specification, settings: Sequence[str]) -> Specification:
    """The specification with some fields by dotted name."""
    document: dict[str, Any] = spec.model_dump(mode="json")
    for setting in settings:
        name, _, value = setting.partition("=")
        put_field(document, name, json.loads(value), None)
    return Specification.model_validate(document)


def _plan_spec(spec: Specification) -> Specification:
    assert spec.arm is not None, "RUN has no arm: give a run of plan or sim"
    arm = spec.arm.model_copy(update={"trial": None, "disturbance": None})
    return spec.model_copy(update={"arm": arm})


def within_reach(scene: SettledScene, candidates: SceneCandidates) -> list[int]:
    """Rows of the candidates that are clear and no farther from the target than their reach."""
    near = distances(candidates, scene.target_center_m)[1] <= candidates.arm_reach_m
    return np.flatnonzero(near & (candidates.clearance_m >= 0)).tolist()


def label_scene(
    labelling: Labelling, scene: SettledScene, candidates: SceneCandidates, rows: Sequence[int]
) -> None:
    """Append the outcomes of the rows."""
    arms: dict[tuple[float, float], ArmInScene] = {}
    for row in rows:
        key = (float(candidates.arm_reach_m[row]), float(candidates.base_height_m[row]))
        start_s = time.process_time()
        if key not in arms:
            arms[key] = arm_in_scene(scene, candidates, row, labelling.spec, StageClock(), labelling.draw)
            _ = arms[key].planning  # timed as preparation
        labelling.prepare_s += time.process_time() - start_s
        start_s = time.process_time()
        trial = try_candidate(arms[key], candidates, row, labelling.spec)
        labelling.plan_s.append(time.process_time() - start_s)
        labelling.outcomes.append(trial.outcome)
        labelling.grasps_free.append(0 if trial.report is None else trial.report.grasps_free)
        labelling.grasps_tried.append(0 if trial.report is None else trial.report.grasps_tried)


def print_flips(first: Labelling, other: Labelling, scene: npt.NDArray[np.int64]) -> None:
    """Shares of labels that differ, with intervals."""
    a, b = np.array(first.outcomes), np.array(other.outcomes)
    good, other_good = a == "success", b == "success"
    flips = good != other_good
    print(f"\n{first.name} against {other.name}")
    print(f"{'':34}{'labels':>8}{'flips':>8}   share, 95% interval")
    sets = {"within reach": np.ones(len(a), bool), "positive": good, "negative": ~good}
    sets |= {f"  {name}": a == name for name, _ in Counter(a[~good].tolist()).most_common()}
    for name, rows in sets.items():
        share, low, high = interval(flips, rows, scene)
        print(f"{name:34}{rows.sum():8}{(flips & rows).sum():8}   {share:.1%} [{low:.1%}, {high:.1%}]")


def interval(
    flips: npt.NDArray[np.bool_], rows: npt.NDArray[np.bool_], scene: npt.NDArray[np.int64]
) -> tuple[float, float, float]:
    """Share of the rows that flip, and its 2.5 and 97.5 percentiles over resampled scenes."""
    _, at = np.unique(scene, return_inverse=True)
    n = int(at.max()) + 1
    some, all_ = (np.bincount(at, weights=w.astype(float), minlength=n) for w in (flips & rows, rows))
    weights = resample_weights(n, _RESAMPLES, np.random.default_rng(0)).astype(float)
    totals = weights @ all_
    drawn = (weights @ some)[totals > 0] / totals[totals > 0]
    low, high = np.percentile(drawn, [2.5, 97.5]) if len(drawn) else (0.0, 0.0)
    return float(some.sum() / max(all_.sum(), 1)), float(low), float(high)


def print_by_target(first: Labelling, other: Labelling, target_of: Sequence[str]) -> None:
    """One line a target with any flip."""
    flips, labels, bad = Counter[str](), Counter[str](), Counter[str]()
    for name, a, b in zip(target_of, first.outcomes, other.outcomes, strict=True):
        labels[name] += 1
        bad[name] += a != "success"
        flips[name] += (a == "success") != (b == "success")
    print(f"{'target':34}{'labels':>8}{'negative':>9}{'flips':>8}")
    for name, count in flips.most_common():
        if count:
            print(f"{name:34}{labels[name]:8}{bad[name]:9}{count:8}")


def print_cost(labelling: Labelling) -> None:
    """CPU milliseconds by outcome."""
    n = len(labelling.outcomes)
    total_ms = 1e3 * sum(labelling.plan_s) / n
    prepare_ms = 1e3 * labelling.prepare_s / n
    free, tried = np.mean(labelling.grasps_free), np.mean(labelling.grasps_tried)
    print(f"\n{labelling.name}: plan {total_ms:.2f} ms, prepare {prepare_ms:.2f} ms a candidate; ", end="")
    print(f"{free:.0f} grasps free, {tried:.1f} tried")
    for name, count in Counter(labelling.outcomes).most_common():
        spent = [s for s, o in zip(labelling.plan_s, labelling.outcomes, strict=True) if o == name]
        print(f"  {name:20}{count:6}{100 * count / n:7.1f}%{1e3 * float(np.mean(spent)):9.2f} ms each")


if __name__ == "__main__":
    main()
