"""Causes of a model's errors: one input at a time is replaced by its true value in the scene.

    python -m benchmarks.error_shares TRAIN --val VAL --test TEST --houses procthor:DIR --objects ycb:DIR
        --test-objects ycb:DIR --out FOLDER [--scenes 1000] [--epochs 8] [--seeds 1]

Runs of `plan`, whose candidates are within reach. `shared` is trained on the first --scenes scenes of TRAIN
and judged on TEST

- as it is: everything is estimated from one observed cloud
- with the true visibility of the target
- with the target's own grasps that the hand can take in the scene, in place of estimated hand poses
- with both
- with half and a quarter of the scenes, in as many epochs and so in fewer steps; and without hand poses

Prints balanced accuracy and AUC with 95% intervals over scenes, and their differences from the first row.
Inputs in FOLDER are used again. Errors that remain with true inputs come from the kinematics that the model
has to learn, and from the noise of labels (`benchmarks.repeatability`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from datagen.display.progress import counting
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.shard_reading import read_scenes
from datagen.train.bootstrap import resample_weights, resampled_area_under_roc
from datagen.train.encoded_runs import EncodedBatches, EncodedRuns, encode_runs, encoded_stream
from datagen.train.hands.poses import HAND_WIDTH, N_MEASURES
from datagen.train.inputs import F32, F64, Array, Bools
from datagen.train.metrics import area_under_roc
from datagen.train.models import Model, build_model
from datagen.train.models.shared import SharedModel
from datagen.train.tensors import to_torch
from datagen.train.training.loop import Position, Training, make_optimiser, run_training
from datagen.train.training.options import STAGES, Options
from datagen.workers.labels.arm_labelling import arm_in_scene
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from datagen.workers.world import open_world

_RESAMPLES = 500
_OPENING = 2  # of the measures, in units of 0.1 m


@dataclass(frozen=True, eq=False)
class Inputs:
    """Encoded scenes with their true visibility and grasps."""

    estimated: EncodedRuns
    visibility: F32  # (N,)
    grasps: Array  # (S, K, HAND_WIDTH) float16

    def with_true(self, *names: str) -> EncodedRuns:
        """The inputs with these columns replaced by the truth."""
        true = {"visible_share": self.visibility, "hand_poses": self.grasps}
        return replace(self.estimated, columns={**self.estimated.columns, **{n: true[n] for n in names}})


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("train")
    for name in ("--val", "--test", "--houses", "--objects", "--test-objects", "--out"):
        parser.add_argument(name, required=True)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)
    out = Path(given.out)
    runs = (
        ("train", given.train, given.objects, given.scenes),
        ("val", given.val, given.objects, None),
        ("test", given.test, given.test_objects, None),
    )
    data = {name: inputs_of(path, given.houses, objects, scenes, out) for name, path, objects, scenes in runs}
    seeds = range(given.seeds)
    both = ("visible_share", "hand_poses")
    rows: dict[str, F64] = {}
    rows["as it is"] = trained(data, (), seeds, given.epochs)
    rows["true visibility"] = trained(data, both[:1], seeds, given.epochs)
    rows["true grasps"] = trained(data, both[1:], seeds, given.epochs)
    rows["both"] = trained(data, both, seeds, given.epochs)
    rows["half of the scenes"] = trained(data, (), seeds, given.epochs, share=0.5)
    rows["a quarter of the scenes"] = trained(data, (), seeds, given.epochs, share=0.25)
    rows["no hand poses"] = trained(data, (), seeds, given.epochs, hand_poses=0)
    test = data["test"].estimated
    scene = test.columns["scene_of_robot"][test.columns["robot_of_candidate"]]
    show(rows, test.columns["label"] == 1, scene)


def inputs_of(path: str, houses: str, objects: str, scenes: int | None, out: Path) -> Inputs:
    """The inputs of a run's first scenes, made in `out` if they are not there yet."""
    with counting("scenes encoded", False) as seen:
        encoded = encode_runs(encoded_stream([path], False), SharedModel({}), out, seen)
    run = Run.open(path)
    count = len(encoded.houses) if scenes is None else scenes
    kept = out / f"{encoded.key}-{count}.npz"
    if not kept.exists():
        with counting("scenes with their grasps", False) as seen:
            true = _true_inputs(run, houses, objects, count, encoded.columns["hand_poses"].shape[1], seen)
        np.savez(kept, visibility=true[0], grasps=true[1])
    with np.load(kept) as file:
        visibility, grasps = file["visibility"], file["grasps"]
    return Inputs(first_scenes(encoded, count), visibility, grasps)


def first_scenes(encoded: EncodedRuns, count: int) -> EncodedRuns:
    """The first `count` scenes alone, with their robots and candidates."""
    robots = int(encoded.robot_bounds[count])
    kept = {
        len(encoded.houses): count,
        len(encoded.columns["scene_of_robot"]): robots,
        len(encoded.columns["label"]): int(encoded.candidate_bounds[robots]),
    }
    columns = {name: values[: kept[len(values)]] for name, values in encoded.columns.items()}
    return EncodedRuns(encoded.key, encoded.tokens[:robots], columns)


def _true_inputs(
    run: Run, houses: str, objects: str, count: int, poses: int, seen: Callable[[int, int], None]
) -> tuple[F32, Array]:
    world = open_world(run.manifest.spec, houses, objects)
    visibility: list[F32] = []
    grasps = np.zeros((count, poses, HAND_WIDTH), np.float16)
    each = run.layout.scenes_per_shard
    numbers = [shard * each + k for shard in sorted(run.committed()) for k in range(each)][:count]
    for row, stored in enumerate(read_scenes(run, numbers)):
        scene = reconstruct_scene(world, stored.record)
        candidates = reconstruct_candidates(stored.samples, scene)
        around = arm_in_scene(scene, candidates, 0, run.manifest.spec, StageClock()).planning.around
        free = np.flatnonzero(around.arrays.is_free > 0)
        kept = free[:poses]
        T = around.arrays.T_world_tcp[kept]
        axes = np.stack([T[:, :3, 3] - scene.target_center_m, T[:, :3, 2], T[:, :3, 1]], axis=1)
        grasps[row, : len(kept), 0] = 1
        grasps[row, : len(kept), _OPENING] = 10 * around.opening_m[around.arrays.opening[kept]]
        grasps[row, :, 1] = np.log1p(len(free))
        grasps[row, : len(kept), N_MEASURES:] = axes.reshape(len(kept), 9)
        # In the order of batches: by robot, then as stored.
        order = np.argsort(stored.samples["robot_index"], kind="stable")
        visibility.append(stored.samples["visibility"][order].astype(np.float32))
        seen(row + 1, count)
    return np.concatenate(visibility), grasps


def trained(
    data: dict[str, Inputs],
    true: Sequence[str],
    seeds: Sequence[int],
    epochs: int,
    share: float = 1.0,
    **config: int,
) -> F64:
    """Mean probabilities (N,) of the test candidates over the seeds."""
    stage = STAGES["sim-only"]
    train, val, test = (data[name].with_true(*true) for name in ("train", "val", "test"))
    scores: list[F32] = []
    for seed in seeds:
        options = Options(
            "sim-only", "shared", config, epochs, lr=stage.lr, weight_decay=stage.weight_decay, seed=seed
        )
        scenes = np.arange(round(share * len(train.houses)))
        model = _train(
            options,
            EncodedBatches(train, scenes, options.batch_scenes, seed),
            EncodedBatches(val, np.arange(len(val.houses)), options.batch_scenes),
        )
        scores.append(_scores(model, test))
    return np.asarray(np.mean(scores, axis=0, dtype=np.float64))


def _train(options: Options, train: EncodedBatches, val: EncodedBatches) -> Model:
    """The model with its best weights."""
    torch.manual_seed(options.seed)
    model = build_model(options.model, options.model_config)
    optimiser = make_optimiser(model, options.lr, options.weight_decay)
    position = Position()
    training = Training(options, model, optimiser, train, val, torch.ones(2), position)
    run_training(training, lambda: None)
    model.load_state_dict(position.best_weights)
    return model.eval()


def _scores(model: Model, encoded: EncodedRuns) -> F32:
    """Probabilities (N,) of label 1 of all candidates."""
    found: list[F32] = []
    with torch.inference_mode():
        for batch in EncodedBatches(encoded, np.arange(len(encoded.houses)), 32).epoch(0):
            given = to_torch(batch, "cpu")
            logits = model.score(given.clouds, given.candidates, given.robots).double()
            found.append(torch.softmax(logits, dim=1)[:, 1].float().numpy())
    return np.concatenate(found)


def show(rows: dict[str, F64], good: Bools, scene: Array) -> None:
    """Print balanced accuracy and AUC of each row, and their differences from the first."""
    n = int(scene.max()) + 1
    weights = resample_weights(n, _RESAMPLES, np.random.default_rng(0))
    measured = {name: _measured(score, good, scene, weights) for name, score in rows.items()}
    first = measured[next(iter(rows))]
    print(f"{len(good):,} candidates of {n:,} scenes, {good.mean():.1%} good")
    print(f"{'':<26}{'balanced accuracy':>22}{'AUC':>22}{'differences':>48}")
    for name, values in measured.items():
        cells = [_cell(v) for v in values]
        apart = [_cell(v - f, sign=True) for v, f in zip(values, first, strict=True)]
        print(f"{name:<26}{cells[0]:>22}{cells[1]:>22}{apart[0]:>24}{apart[1]:>24}")


def _measured(score: F64, good: Bools, scene: Array, weights: Array) -> tuple[F64, F64]:
    """Balanced accuracy and AUC, each (1 + B,): the value, then its resamples."""
    ones = np.ones((1, weights.shape[1]), weights.dtype)
    every = np.concatenate([ones, weights])
    right = (score >= 0.5) == good
    sums = [np.bincount(scene, side, weights.shape[1]) for side in (right & good, good, right & ~good, ~good)]
    a, b, c, d = (every.astype(np.float64) @ s for s in sums)
    area = np.concatenate(
        [[area_under_roc(good, score)], resampled_area_under_roc(weights, good, score, scene)]
    )
    return (a / b + c / d) / 2, area


def _cell(values: F64, sign: bool = False) -> str:
    low, high = np.nanpercentile(values[1:], [2.5, 97.5])
    one = "{:+.1f}" if sign else "{:.1f}"
    return f"{one.format(100 * values[0])} [{one.format(100 * low)}, {one.format(100 * high)}]"


if __name__ == "__main__":
    main()
