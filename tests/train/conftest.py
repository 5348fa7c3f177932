"""Finished runs on the built-in world, made once for all tests of training, whoever asks first."""

from __future__ import annotations

import fcntl
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen import cli
from tests.sim_extra import SIM_INSTALLED
from tests.small_runs import CONFIG, make_small_run

SCENES, CANDIDATES, TRIED = 12, 16, 6
# Arms long enough to take something, and little else to see, plan and execute.
ARM = """
[scene]
n_clutter = 2

[candidates]
arm_reach_m = {low = 0.6, high = 1.0}

[arm.grasps]
per_scene = 8
"""


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of this test session share."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if base.name.startswith("popen-") else base) / "train-runs"
    shared.mkdir(exist_ok=True)
    return shared


def once(folder: Path, make: Callable[[], object]) -> Path:
    """The folder, made by the first who comes; the others wait for it."""
    with open(f"{folder}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = Path(f"{folder}.done")
        if not done.exists():
            make()
            done.touch()
    return folder


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
