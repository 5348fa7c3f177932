"""Heuristic labels need nothing of the `sim` extra; other labels say that it is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

# As if none of them were installed, nor what they bring.
WITHOUT = """
import sys
from importlib.machinery import PathFinder

MISSING = {"pinocchio", "coal", "ompl", "mani_skill", "mplib", "gymnasium", "h5py", "torch"}
find_spec = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.split(".")[0] in MISSING else find_spec(name, *rest)

from datagen import cli

sys.exit(cli.run(sys.argv[1:]))
"""


def datagen_without_sim(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_heuristic_labels_are_made_shown_and_audited_without_it(tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    made = datagen_without_sim("submit", "heuristic", "--n", "60", "--out", run, "--workers", "0")
    assert made.returncode == 0, made.stderr
    picture = tmp_path / "scene.png"
    shown = datagen_without_sim("show", run, "--scene", "0", "--out", str(picture))
    assert shown.returncode == 0 and picture.is_file(), shown.stderr
    audited = datagen_without_sim("audit", run, "--json")
    assert audited.returncode == 0 and json.loads(audited.stdout), audited.stderr


@pytest.mark.parametrize("source", ["plan", "sim"])
def test_other_labels_name_the_extra_in_one_line(tmp_path: Path, source: str) -> None:
    asked = datagen_without_sim(
        "submit", source, "--n", "60", "--out", str(tmp_path / "run"), "--workers", "0"
    )
    assert asked.returncode == 2
    assert "pip install 'datagen[sim]'" in asked.stderr and "Traceback" not in asked.stderr
    assert len(asked.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()
