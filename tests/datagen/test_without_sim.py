"""Heuristic labels need nothing of the `sim` extra; other labels say that it is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.small_runs import PER_SCENE, submit_arguments

# As if none of them were installed, nor what they bring.
WITHOUT = """
import json
import sys
from importlib.machinery import PathFinder

MISSING = {"pinocchio", "coal", "ompl", "mani_skill", "mplib", "gymnasium", "h5py", "torch"}
find_spec = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.split(".")[0] in MISSING else find_spec(name, *rest)

from datagen import cli

for arguments in json.loads(sys.argv[1]):
    if code := cli.run(arguments):
        sys.exit(code)
"""


def datagen_without_sim(*commands: list[str]) -> subprocess.CompletedProcess[str]:
    """These commands one after another, up to the first that fails."""
    command = [sys.executable, "-c", WITHOUT, json.dumps(commands)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def test_heuristic_labels_are_made_shown_and_audited_without_it(tmp_path: Path) -> None:
    run, picture = tmp_path / "run", tmp_path / "scene.png"
    show = ["show", str(run), "--scene", "0", "--out", str(picture)]
    done = datagen_without_sim(submit_arguments(run, PER_SCENE), show, ["audit", str(run), "--json"])
    assert done.returncode == 0, done.stderr
    assert picture.is_file()
    assert json.loads(done.stdout[done.stdout.index("\n{") :])["sources"]


@pytest.mark.parametrize("source", ["plan", "sim"])
def test_other_labels_name_the_extra_in_one_line(tmp_path: Path, source: str) -> None:
    command = ["submit", source, "--n", "60", "--out", str(tmp_path / "run"), "--workers", "0"]
    asked = datagen_without_sim(command)
    assert asked.returncode == 2
    assert "pip install 'datagen[sim]'" in asked.stderr and "Traceback" not in asked.stderr
    assert len(asked.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()
