"""What random orders of a cloud's points do to a model's scores, as a table.

    python -m benchmarks.point_orders RUN [--checkpoint CKPT] [--orders 8]

A cloud's tokens are at its first points, and so depend on the order in which points are stored. RUN is a
`plan` run of whole grids. Rows are the stored order, and means over n random orders, on average over all
groups of n; columns are of the clear candidates within reach.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from datagen import released
from datagen.schemas.specification import DECISIVE_SHARES
from datagen.train.dataset import SampleStream
from datagen.train.inputs import F64, Bools, in_random_order
from datagen.train.metrics import area_under_roc
from datagen.train.tensors import to_torch
from datagen.train.training.checkpoints import load_model

_COUNTS = (1, 2, 4, 8)


def main() -> None:
    """Score each scene in all orders and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--checkpoint")
    parser.add_argument("--orders", type=int, default=max(_COUNTS))
    options = parser.parse_args()
    model, _ = load_model(options.checkpoint or released.released_checkpoint())
    model.eval()
    scenes = list[tuple[F64, Bools]]()  # scores (1 + orders, N) and labels (N,)
    extra = ("base_is_clear", "mount_distance_m")
    for batch in SampleStream([options.run], scenes_per_batch=1, shuffle=False, extra=extra).epoch(0):
        near = batch.extra["mount_distance_m"] <= batch.robots.arm_reach_m[batch.candidates.robot_row]
        if not (near := near & batch.extra["base_is_clear"]).any():
            continue
        given = to_torch(batch, "cpu")
        clouds = [given.clouds, *(in_random_order(given.clouds, k) for k in range(options.orders))]
        with torch.inference_mode():
            logits = [model.score(each, given.candidates, given.robots).double() for each in clouds]
            chance = torch.stack([torch.softmax(each, dim=1)[:, 1] for each in logits]).numpy()
        scenes.append((chance[:, near], batch.label[near] == 1))
    decisive = [DECISIVE_SHARES[0] <= label.mean() <= DECISIVE_SHARES[1] for _, label in scenes]
    count = sum(len(label) for _, label in scenes)
    print(f"{count:,} candidates of {len(scenes)} scenes, {sum(decisive)} of them decisive\n")
    print("| orders | balanced accuracy | AUC | log loss | feasible AUC | picks good | in decisive scenes |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    groups = {"stored": [[0]]}
    for n in _COUNTS:
        if n <= options.orders:
            firsts = range(1, 2 + options.orders - n, n)
            groups[str(n)] = [list(range(first, first + n)) for first in firsts]
    for name, rows in groups.items():
        found = np.mean([_measures(scenes, decisive, group) for group in rows], axis=0)
        cells = [f"{value:.3f}" if k == 2 else f"{100 * value:.1f}" for k, value in enumerate(found)]
        print(f"| {name} | {' | '.join(cells)} |")


def _measures(scenes: list[tuple[F64, Bools]], decisive: list[bool], rows: list[int]) -> list[float]:
    chance = [each[rows].mean(axis=0) for each, _ in scenes]
    score, true = np.concatenate(chance), np.concatenate([label for _, label in scenes])
    balanced = ((score[true] >= 0.5).mean() + (score[~true] < 0.5).mean()) / 2
    loss = -np.log(np.where(true, score, 1 - score).clip(1e-6)).mean()
    feasible = np.array([label.any() for _, label in scenes])
    best = np.array([each.max() for each in chance])
    good = np.array([label[each.argmax()] for each, (_, label) in zip(chance, scenes, strict=True)])
    roc = area_under_roc(true, score), area_under_roc(feasible, best)
    return [balanced, roc[0], loss, roc[1], good[feasible].mean(), good[decisive].mean()]


if __name__ == "__main__":
    main()
