"""What people and programs are shown while a model trains."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from schemas.errors import InputError
from train.training.display import JsonLines, Pace, TerminalBar, clock_text, display
from train.training.watching import Step, TensorBoard

RECORD: dict[str, Any] = {
    "epoch": 3, "step": 30, "loss": 0.5, "accuracy": 0.7, "val_loss": 0.25, "val_accuracy": 0.875,
    "val_balanced_accuracy": None, "val_auc": None, "best": True,
}  # fmt: skip


def step(k: int, step_s: float = 2.0) -> Step:
    return Step(k, 100, 1, 0.5, 1e-3, samples=60, wait_s=0.1 * step_s, step_s=step_s)


def test_pace_is_that_of_the_last_minute():
    pace = Pace()
    for k in range(1, 6):
        pace.see(step(k, 100.0))
    for k in range(6, 41):
        pace.see(step(k))
    assert pace.samples_per_s == pytest.approx(30)
    assert pace.loader_share == pytest.approx(0.1)
    assert pace.left_s() == pytest.approx(120)
    assert clock_text(3725.4) == "1:02:05"


def test_a_bar_shows_numbers_and_a_line_an_epoch(capfd: pytest.CaptureFixture[str]):
    bar = TerminalBar(100)
    bar.step(step(31))
    bar.epoch(RECORD)
    bar.close()
    told = capfd.readouterr().err
    assert "epoch   3  loss 0.5000  validation 0.2500  accuracy 0.8750  best" in told
    assert "31/100" in told
    assert "None" not in told


def test_lines_are_json_also_on_a_terminal(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    lines = display("a.ckpt", 100, 0, as_json=True)
    assert isinstance(lines, JsonLines)
    monkeypatch.setattr("time.monotonic", lambda: 1e12)
    lines.step(step(31))
    lines.step(step(32))
    lines.epoch(RECORD)
    first, second = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    assert (first["event"], first["step"], first["steps"], first["left_s"]) == ("progress", 31, 100, 138)
    assert (first["samples_per_s"], first["loader_share"]) == (30.0, 0.1)
    assert (second["event"], second["val_auc"], second["best"]) == ("epoch", None, True)


def test_curves_need_their_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(InputError, match="--tensorboard: the package tensorboard is not installed"):
        TensorBoard(str(tmp_path))
