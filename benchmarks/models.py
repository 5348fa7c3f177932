"""Ablations of the `shared` model: variants trained on runs and judged on others, as a table.

    python -m benchmarks.models --train RUN [RUN ...] --judge RUN [--samples N] [--epochs 10]

Every variant sees the same batches in the same order: AdamW, one cycle of learning rates up to 1e-3, weight
decay 0.01, cross-entropy. The tokens have no parameters, and are made once. Accuracy, balanced accuracy and
area under the curve are of all samples judged, means over `--seeds` trainings; CPU seconds are those of one
training without reading and without making tokens.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.train.dataset import SampleStream
from datagen.train.inputs import Batch
from datagen.train.metrics import accuracy, area_under_roc, balanced_accuracy, confusion
from datagen.train.models.shared import SharedModel
from datagen.train.models.tokens import Tokens
from datagen.train.tensors import to_torch

# Name -> changes of the configuration, and the layers whose output is held at zero.
VARIANTS: dict[str, tuple[Mapping[str, Any], Sequence[str]]] = {
    "default": ({}, ()),
    "no tokens": ({}, ("pooled",)),  # scalars and the target's shape
    "tokens without directions": ({}, ("vectors", "tensors")),
    "tokens without lines of sight and arm": ({}, ("pair",)),
    "left and right told apart": ({"mirrored": False}, ()),
    "twice the tokens": ({"tokens": (32, 64, 64)}, ()),
    "camera unknown": ({"camera": "unknown"}, ()),
    "no estimated visibility": ({"observed_visibility": False}, ()),
    "no hand poses": ({"hand_poses": 0}, ()),
}
Encoded = list[tuple[Batch[Tensor], Tokens]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--train", nargs="+", required=True)
    parser.add_argument("--judge", nargs="+", required=True)
    parser.add_argument("--samples", type=int, default=10**9, help="most samples to train on")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scenes-per-batch", type=int, default=8)
    parser.add_argument("--only", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    learn = _batches(options.train, options.scenes_per_batch, options.samples)
    judge = _batches(options.judge, 16, 10**9)
    print(f"{sum(map(len, learn))} samples to learn from, {sum(map(len, judge))} to judge by")
    print(f"{'variant':<38} {'accuracy':>8} {'balanced':>8} {'AUC':>6} {'CPU s':>6}")
    for words in options.only:
        config, silent = VARIANTS[words]
        rows = [_trained(config, silent, learn, judge, options.epochs, seed) for seed in range(options.seeds)]
        right, balanced, area, cpu_s = np.mean(rows, axis=0)
        print(f"{words:<38} {right:>8.4f} {balanced:>8.4f} {area:>6.4f} {cpu_s:>6.0f}", flush=True)


def _batches(paths: Sequence[str], scenes: int, most: int) -> list[Batch[Tensor]]:
    batches: list[Batch[Tensor]] = []
    for batch in SampleStream(paths, scenes_per_batch=scenes).epoch(0):
        if sum(map(len, batches)) >= most:
            break
        batches.append(to_torch(batch, "cpu"))
    return batches


def _trained(
    config: Mapping[str, Any],
    silent: Sequence[str],
    learn: Sequence[Batch[Tensor]],
    judge: Sequence[Batch[Tensor]],
    epochs: int,
    seed: int,
) -> tuple[float, float, float, float]:
    torch.manual_seed(seed)
    model = SharedModel(config)
    for name in silent:
        for parameter in getattr(model, name).parameters():
            torch.nn.init.zeros_(parameter).requires_grad_(False)
    encoded, judged = _encoded(model, learn), _encoded(model, judge)
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, 1e-3, total_steps=epochs * len(encoded), pct_start=0.15
    )
    rng = np.random.default_rng(seed)
    busy = time.process_time()
    for _ in range(epochs):
        for row in rng.permutation(len(encoded)):
            loss = torch.nn.functional.cross_entropy(_logits(model, *encoded[row]), encoded[row][0].label)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimiser.step()
            schedule.step()
    busy = time.process_time() - busy
    model.eval()
    with torch.inference_mode():
        logits = torch.cat([_logits(model, *pair) for pair in judged])
    score = (logits[:, 1] - logits[:, 0]).double().numpy()
    true = torch.cat([batch.label for batch, _ in judged]).numpy() == 1
    counts = confusion((score > 0).astype(np.float64), true, np.zeros(len(true), np.int64), 1)[0]
    return float(accuracy(counts)), float(balanced_accuracy(counts)), area_under_roc(true, score), busy


def _encoded(model: SharedModel, batches: Sequence[Batch[Tensor]]) -> Encoded:
    return [(batch, model.encode(batch.clouds, batch.robots)) for batch in batches]


def _logits(model: SharedModel, batch: Batch[Tensor], tokens: Tokens) -> Tensor:
    return model.score_tokens(tokens, batch.clouds, batch.candidates, batch.robots)


if __name__ == "__main__":
    main()
