"""A run without a positive label asks whether its robot is right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.reports.agreement import doubt, read_labels
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import Run
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, HERE, OPEN_TOPS, json_of

pytestmark = needs_sim

EACH = 28
# A hand that keeps farther from the target than its pregrasp is.
FEW_GRASPS = "[arm.motion]\nmargin_m = 0.2\n[arm.grasps]\nper_object = 40\nper_scene = 10\n"
NO_GRASP = CONFIG + OPEN_TOPS + FEW_GRASPS


def test_a_run_and_its_audit_ask_where_no_label_is_positive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.toml").write_text(NO_GRASP)
    run = tmp_path / "run"
    line = ["submit", "plan", "--robot", "panda", "--candidates-per-scene", str(EACH), "--out", str(run)]
    line += ["--candidates", "in-range"]
    line += ["--config", str(tmp_path / "run.toml"), *HERE]

    def told(*words: str) -> list[str]:
        capsys.readouterr()
        assert cli.run([*words]) == 0
        return [text for text in capsys.readouterr().out.splitlines() if "positive (" in text]

    assert told(*line, "--n", str(EACH)) == []  # too few to ask
    wanted = (
        f"{run}: none of {2 * EACH} labels is positive (no_grasp {2 * EACH}): is robot panda right?"
        " See: datagen robot panda"
    )
    assert told(*line, "--n", str(2 * EACH)) == [wanted]
    assert told(*line, "--n", str(2 * EACH)) == [wanted]  # nothing is left to make
    assert told("audit", str(run)) == [wanted]
    assert json_of(capsys, [*line, "--n", str(2 * EACH)])["doubt"] == wanted
    assert json_of(capsys, ["audit", str(run)])["sources"][0]["doubts"] == [wanted]

    labels = read_labels(Run.open(run))
    codes = np.array([list(OUTCOMES).index(name) for name in ("no_ik", "out_of_reach", "no_path", "no_lift")])
    mixed = np.repeat(codes, (9, 40, 5, 2)).astype(np.uint8)
    assert "(out_of_reach 40, no_ik 9, no_path 5)" in doubt(replace(labels, outcome=mixed))
    one = labels.label.copy()
    one[7] = True
    assert doubt(replace(labels, label=one)) == ""
    assert doubt(replace(labels, outcome=None)) == ""
