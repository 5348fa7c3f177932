"""Tucked poses are those that paths leave: a pose that hangs below tables costs labels."""

from __future__ import annotations

from pathlib import Path

import pytest

import datagen
from datagen import cli
from tests.sim_extra import needs_sim
from tests.small_runs import OPEN_TOPS


@needs_sim
@pytest.mark.slow
def test_most_grasps_that_fetch_can_take_have_a_path(tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    (tmp_path / "tops.toml").write_text(OPEN_TOPS)
    near = ["--candidates", "in-range", "--candidates-per-scene", "15"]
    submit = ["submit", "plan", "--n", "90", "--seed", "1", "--robot", "fetch", *near]
    assert cli.run([*submit, "--out", run, "--workers", "0", "--config", str(tmp_path / "tops.toml")]) == 0
    outcomes = datagen.candidates(run)["outcome"].tolist()
    found, without = (outcomes.count(name) for name in ("success", "no_path"))
    assert found + without > 45 and without < 0.12 * (found + without)
