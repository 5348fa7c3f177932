"""The loop: what stops anywhere goes on bit for bit, and what is no number ends it before harm is done."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen.schemas.errors import InputError
from datagen.train.inputs import Array, Batch
from datagen.train.training.checkpoints import load_model, read_checkpoint
from datagen.train.training.loop import Batches, run_training
from datagen.train.training.training_setup import prepare_training, save_checkpoint
from tests.train.training.small import TINY_PAPER, Recorder, equal, job_of, train_until


@pytest.mark.parametrize(
    "config",
    [{}, {"model": "paper", "model_config": TINY_PAPER}],  # the latter with statistics of batches as well
    ids=["shared", "paper"],
)
def test_stopped_at_every_step_training_ends_the_same_and_is_left_as_it_is(
    config: dict[str, Any], heuristic_run: Path, tmp_path: Path
):
    whole, halting = (job_of(heuristic_run, tmp_path / name, **config) for name in ("whole", "halting"))
    assert train_until(whole)[0]
    for step in range(1, 7):
        assert train_until(halting, step)[0] is False
        assert read_checkpoint(halting.out).head.step == step
    assert train_until(halting)[0]
    truth, gone_on = read_checkpoint(whole.out), read_checkpoint(halting.out)
    assert truth.head.step == 6
    assert equal(gone_on.resume, truth.resume) and equal(gone_on.weights, truth.weights)
    assert gone_on.head.history == truth.head.history and gone_on.loop == truth.loop
    before = Path(whole.out).read_bytes()
    done, seen = train_until(whole)
    assert done and truth.head.finished and not seen.steps
    assert Path(whole.out).read_bytes() == before


def test_the_best_epoch_is_kept_and_patience_ends_it(heuristic_run: Path, tmp_path: Path):
    job = job_of(heuristic_run, tmp_path / "c.ckpt", epochs=40, patience=2, lr=0.3)
    done, seen = train_until(job)
    checkpoint = read_checkpoint(job.out)
    losses = [row["val_loss"] for row in checkpoint.head.history]
    best = int(np.argmin(losses)) + 1
    assert done
    assert checkpoint.head.best_epoch == best
    assert len(losses) == best + 2 < 40
    assert [row["best"] for row in seen.epochs][best - 1 :] == [True, False, False]
    last = {k.removeprefix("model."): v for k, v in checkpoint.resume.items() if k.startswith("model.")}
    assert not equal(checkpoint.weights, last)
    model, head = load_model(job.out)
    assert equal(model.state_dict(), checkpoint.weights)
    assert head == checkpoint.head


class Spoilt:
    """Batches of a stream, of which one holds a number that is none."""

    def __init__(self, batches: Batches, at: int, rows: list[int]) -> None:
        self._batches, self._at, self._rows = batches, at, rows
        self.batches_per_epoch = batches.batches_per_epoch
        self.ids: list[str] = []

    def epoch(self, k: int, skip_batches: int = 0) -> Iterator[Batch[Array]]:
        for i, batch in enumerate(self._batches.epoch(k, skip_batches), skip_batches):
            if k * self.batches_per_epoch + i == self._at:
                base_xy_m = batch.candidates.base_xy_m.copy()
                base_xy_m[self._rows] = np.nan
                self.ids = [bytes(batch.sample_id[row]).hex() for row in self._rows]
                candidates = dataclasses.replace(batch.candidates, base_xy_m=base_xy_m)
                batch = dataclasses.replace(batch, candidates=candidates)
            yield batch


def test_a_loss_that_is_not_finite_names_its_samples_and_keeps_the_weights(
    heuristic_run: Path, tmp_path: Path
):
    job = job_of(heuristic_run, tmp_path / "c.ckpt")
    training, _ = prepare_training(job)
    rows = [3, 5, 6, 20, 21]
    spoilt = Spoilt(training.train, 4, rows)
    kept: list[int] = []
    seen = Recorder()
    with pytest.raises(InputError, match="loss: is not finite") as error:
        run_training(
            dataclasses.replace(training, train=spoilt), lambda: kept.append(training.position.step), [seen]
        )
    assert error.value.place == "training, epoch 2, batch 2"
    assert f"for 5 samples: {', '.join(spoilt.ids[:4])}, ..." in error.value.problem
    assert spoilt.ids[4] not in str(error.value)
    assert kept == [3]
    assert all(torch.isfinite(p).all() for p in training.model.parameters())


def test_a_gradient_that_is_not_finite_ends_training(heuristic_run: Path, tmp_path: Path):
    training, _ = prepare_training(job_of(heuristic_run, tmp_path / "c.ckpt"))
    first = next(iter(training.model.parameters()))
    first.register_hook(lambda gradient: gradient * float("nan"))
    before = {k: v.clone() for k, v in training.model.state_dict().items()}
    with pytest.raises(InputError, match="gradient: is not finite for "):
        run_training(training, lambda: None)
    assert equal(training.model.state_dict(), before)


def test_weights_that_overflow_do_not_replace_a_good_checkpoint(heuristic_run: Path, tmp_path: Path):
    """A loss is looked at before a step, so that weights can be lost where the step is the last one."""
    job = job_of(heuristic_run, tmp_path / "c.ckpt")
    assert train_until(job, 2)[0] is False
    before = Path(job.out).read_bytes()
    training, head = prepare_training(job)
    weight = next(iter(training.model.parameters()))
    training.optimiser.register_step_post_hook(lambda *_: weight.data.fill_(float("inf")))
    with pytest.raises(InputError, match=r"has NaN or infinite numbers\. Nothing was overwritten"):
        run_training(training, lambda: save_checkpoint(job.out, training, head), (), lambda: True)
    assert Path(job.out).read_bytes() == before


def test_steps_report_loss_time_and_samples_and_classes_have_equal_weight(
    heuristic_run: Path, tmp_path: Path
):
    job = job_of(heuristic_run, tmp_path / "c.ckpt")
    training, _ = prepare_training(job)
    counts, weights = np.array(training.train.class_counts()), training.class_weights.numpy()  # type: ignore[attr-defined]
    assert weights[0] * counts[0] == pytest.approx(weights[1] * counts[1])
    assert (weights * counts).sum() == pytest.approx(counts.sum())
    _, seen = train_until(job)
    head = read_checkpoint(job.out).head
    assert [s.step for s in seen.steps] == [1, 2, 3, 4, 5, 6]
    assert {s.steps for s in seen.steps} == {6}
    per_epoch = sum(s.samples for s in seen.steps[:3])
    assert per_epoch == sum(run["n_samples"] for run in head.data)
    assert all(0 <= s.wait_s <= s.step_s for s in seen.steps)
    assert head.cost["train_wall_s"] >= sum(s.step_s for s in seen.steps) * 0.999
    assert head.cost["label_cpu_s"] > 0
    rows: list[dict[str, Any]] = [{k: v for k, v in row.items() if k != "best"} for row in seen.epochs]
    assert tuple(rows) == head.history
