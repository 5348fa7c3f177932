"""Finished runs on the built-in world, made once for all tests of training, whoever asks first."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from tests.conftest import once
from tests.sim_extra import SIM_INSTALLED
from tests.small_runs import CONFIG, make_small_run

SCENES, CANDIDATES, TRIED = 12, 16, 6
# Arms long enough to take something, and little else to see, plan and execute.
ARM = """
[scene]
places = {}
n_clutter = 2

[candidates]
arm_reach_m = {low = 0.6, high = 1.0}

[arm.grasps]
per_object = 40
per_scene = 8
"""


@pytest.fixture(scope="session")
def heuristic_run(shared_folder: Path) -> Path:
    """12 scenes, each with 4 robots and 16 candidates. Read it, never change it."""
    out = shared_folder / "heuristic"
    return once(out, lambda: make_small_run(out, SCENES * CANDIDATES, per_scene=CANDIDATES))


@pytest.fixture(scope="session")
def sim_run(shared_folder: Path) -> Path:
    """12 scenes, each with one robot and 6 clear candidates within reach."""
    if not SIM_INSTALLED:
        pytest.skip("the extra `sim` is not installed")
    out = shared_folder / "sim"
    return once(out, lambda: make_sim_run(out))


def make_sim_run(out: Path) -> None:
    file = out.parent / "sim.toml"
    file.write_text(CONFIG + ARM)
    words = ["submit", "sim", "--n", str(SCENES * TRIED), "--out", str(out), "--candidates", "in-range"]
    more = ["--candidates-per-scene", str(TRIED), "--workers", "0"]
    assert cli.run([*words, *more, "--config", str(file)]) == 0
