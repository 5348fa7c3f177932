"""What people and programs are shown while a model trains."""

from __future__ import annotations

import io
import json
from typing import Any

import pytest
from rich.console import Console

from datagen.display.progress import Progress
from datagen.train.training.loop import TrainingProgress, TrainingStep

RECORD: dict[str, Any] = {
    "epoch": 4, "step": 40, "loss": 0.5, "accuracy": 0.7, "val_loss": 0.25, "val_accuracy": 0.875,
    "val_balanced_accuracy": None, "val_auc": None, "best": True,
}  # fmt: skip


def step(k: int, step_s: float = 2.0) -> TrainingStep:
    return TrainingStep(k, 100, 1, 0.5, samples=60, wait_s=0.1 * step_s, step_s=step_s)


def test_lines_are_json_also_on_a_terminal_with_the_speed_of_the_last_minute():
    out = io.StringIO()
    shown = Progress(as_json=True, console=Console(file=out, force_terminal=True))
    lines = TrainingProgress(shown, "a.ckpt")
    for k in range(1, 6):
        lines.step(step(k, 100.0))
    for k in range(6, 41):
        lines.step(step(k))
    lines.epoch(RECORD)
    shown.close()
    epoch, last = [json.loads(line) for line in out.getvalue().splitlines()]
    assert (epoch["event"], epoch["val_auc"], epoch["best"]) == ("epoch", None, True)
    assert epoch["samples_per_s"] == pytest.approx(30)
    assert epoch["loader_share"] == pytest.approx(0.1)
    assert (last["event"], last["step"], last["steps"], last["left_s"]) == ("progress", 40, 100, 120)


def test_progress_shows_numbers_and_a_row_per_epoch():
    out = io.StringIO()
    with Progress(console=Console(file=out, force_terminal=True, width=110, color_system=None)) as shown:
        bar = TrainingProgress(shown, "a.ckpt")
        bar.step(step(31))
        bar.epoch(RECORD)
    told = out.getvalue()
    assert "epoch   4  loss 0.5000  validation 0.2500  accuracy 0.8750  best" in told
    assert "31/100" in told and "30 samples/s  0:02:18 left  data 10%" in told
    assert "None" not in told


def test_the_time_left_has_the_validations_of_the_epochs_left():
    out, now_s = io.StringIO(), [0.0]
    shown = Progress(as_json=True, clock=lambda: now_s[0], console=Console(file=out))
    lines = TrainingProgress(shown, "a.ckpt")

    def left_s(k: int) -> int:
        lines.step(step(k))
        now_s[0] += 20.0  # steps are counted by the time that they took
        lines.step(step(k))
        return json.loads(out.getvalue().splitlines()[-1])["left_s"]

    assert left_s(39) == 122
    now_s[0] += 30.0
    lines.epoch(RECORD)
    assert left_s(41) == 118 + 6 * 30
    lines.epoch({**RECORD, "epoch": 10, "step": 100})
    assert left_s(100) == 0
