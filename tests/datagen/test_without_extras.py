"""Heuristic labels need no extra; what needs one says in a line what is missing and how to install it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.sim_extra import needs_sim
from tests.small_runs import PER_SCENE, submit_arguments
from tests.train.conftest import sim_run
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import draw_seen, write_frame

__all__ = ["sim_run"]

# As if none of these were installed.
WITHOUT = """
import json
import sys
from importlib.machinery import PathFinder

missing, commands = json.loads(sys.argv[1])
find_spec = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.split(".")[0] in missing else find_spec(name, *rest)

from datagen import cli

for arguments in commands:
    if code := cli.run(arguments):
        sys.exit(code)
"""


SIM = ("pinocchio", "coal", "ompl", "mani_skill", "mplib", "gymnasium", "h5py", "torch")


def datagen_without(missing: Sequence[str], *commands: list[str]) -> subprocess.CompletedProcess[str]:
    """These commands one after another, up to the first that fails."""
    command = [sys.executable, "-c", WITHOUT, json.dumps([missing, commands])]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def refused_line(told: subprocess.CompletedProcess[str]) -> str:
    """The one line of a command that was refused."""
    assert told.returncode == 2, told.stderr
    assert told.stdout == "" and told.stderr.count("\n") == 1 and told.stderr.startswith("error: ")
    return told.stderr


def test_heuristic_labels_are_made_shown_and_audited_without_it(tmp_path: Path) -> None:
    run, picture = tmp_path / "run", tmp_path / "scene.png"
    show = ["show", str(run), "--scene", "0", "--out", str(picture)]
    done = datagen_without(SIM, submit_arguments(run, PER_SCENE), show, ["audit", str(run), "--json"])
    assert done.returncode == 0, done.stderr
    assert picture.is_file()
    assert json.loads(done.stdout[done.stdout.index("\n{") :])["sources"]


@pytest.mark.parametrize("source", ["plan", "sim"])
def test_other_labels_name_the_extra_in_one_line(tmp_path: Path, source: str) -> None:
    command = ["submit", source, "--n", "60", "--out", str(tmp_path / "run"), "--workers", "0"]
    assert "Install the extra sim: pip install" in refused_line(datagen_without(SIM, command))
    assert not (tmp_path / "run").exists()


def test_training_and_prediction_name_torch_in_one_line(finished: Path, tmp_path: Path) -> None:
    checkpoint, out = tmp_path / "model.ckpt", tmp_path / "new.ckpt"
    write_untrained(checkpoint, {})
    write_frame(tmp_path / "frame", draw_seen(0))
    robot = ["--base-height", "0.7", "--reach", "0.9", "--camera-height", "0.8"]
    predict = ["predict", str(checkpoint), "--frame", str(tmp_path / "frame"), *robot]
    for command in (
        ["train", "stage1", str(finished), "--out", str(out)],
        [*predict, "--json"],
    ):
        line = refused_line(datagen_without(["torch"], command))
        assert "torch: is not installed. Install the extra train: pip install" in line
        assert " datagen[" not in line and not out.exists()
    page = [*predict, "--html", str(tmp_path / "page.html"), "--out", str(tmp_path / "a.png")]
    line = refused_line(datagen_without(["plotly"], page))
    assert "plotly: is not installed. Install the extra train: pip install" in line
    assert not (tmp_path / "a.png").exists()


@needs_sim
def test_evaluation_names_torch_in_one_line(sim_run: Path, tmp_path: Path) -> None:
    write_untrained(tmp_path / "model.ckpt", {})
    command = ["evaluate", str(tmp_path / "model.ckpt"), str(sim_run), "--json"]
    line = refused_line(datagen_without(["torch"], command))
    assert "torch: is not installed. Install the extra train: pip install" in line
