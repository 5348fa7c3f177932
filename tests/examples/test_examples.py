"""The examples as a user runs them, one after the other on shared runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import datagen

# Three starts of Ray on a machine that may be busy.
pytestmark = pytest.mark.timeout(900)
EXAMPLES = Path(__file__).parents[2] / "examples"


def run_example(name: str, *arguments: str | Path) -> str:
    """What the example prints; it runs in a folder of its own."""
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    # The shell that calls may lead to another checkout.
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(EXAMPLES.parent)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the runs of the first example and the model of the second."""
    folder = tmp_path_factory.mktemp("examples")
    told = run_example("make_labels.py", folder)
    assert "240 new labels, complete" in told and "120 new labels, complete" in told
    assert "share good" in told and "point" in told
    told = run_example("train_on_labels.py", folder)
    assert "validation accuracy" in told and "epoch 2: loss" in told
    return folder


def test_labels_are_made_and_a_model_is_trained_on_them(folder: Path) -> None:
    table = datagen.candidates(folder / "train", folder / "val")
    assert len(table) == 360
    assert set(table["split"].iloc[:240]) == {"train"} and set(table["split"].iloc[240:]) == {"val"}


def test_the_model_says_where_to_park(folder: Path) -> None:
    told = run_example("park_a_robot.py", folder)
    assert "park at x" in told and "T_map_mount" in told


def test_runs_of_a_cluster_are_resumed_and_merged(tmp_path: Path) -> None:
    told = run_example("run_a_cluster.py", tmp_path)
    assert told.count("complete, 120 new labels") == 2
    assert told.count("0 shards missing, 0 in quarantine") == 2
    assert f"{tmp_path}/merged: 240 labels" in told


def test_every_example_is_short_and_executed_here() -> None:
    scripts = sorted(EXAMPLES.glob("*.py"))
    here = Path(__file__).read_text()
    assert len(scripts) == 4 and all(f'"{script.name}"' in here for script in scripts)
    assert all(len(script.read_text().splitlines()) <= 65 for script in scripts)
