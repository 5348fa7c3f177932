"""A machine that has no machine code of the planner yet is told so before it is made."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datagen import cli
from tests.sim_extra import needs_sim
from tests.small_runs import HERE, PER_SCENE, make_small_run

pytestmark = needs_sim

PLANNER = "compiling the planner for this machine, once: about 20 s"
KINEMATICS = "compiling kinematics for this machine, once: about 5 s"


def test_a_job_says_that_the_planner_is_compiled_before_its_first_label(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from datagen.workers.kinematics.compiler import code_folder

    source = make_small_run(tmp_path / "source", PER_SCENE, "--robot", "panda", "--candidates", "in-range")

    def told(kind: str, out: str) -> list[str]:
        line = [
            "submit",
            kind,
            "--n",
            str(PER_SCENE),
            "--scenes-from",
            str(source),
            "--out",
            str(tmp_path / out),
            *HERE,
        ]
        capsys.readouterr()
        assert cli.run([*line, "--robot", "panda"] if kind == "plan" else line) == 0
        return capsys.readouterr().err.splitlines()

    told("plan", "first")
    assert PLANNER not in told("plan", "second")
    monkeypatch.setattr("datagen.workers.kinematics.compiler.cache_folder", lambda: tmp_path / "empty")
    code_folder.cache_clear()
    try:
        lines = told("plan", "third")
        assert lines.count(PLANNER) == 1
        assert lines.index(PLANNER) < lines.index("making labels")
        assert PLANNER not in told("plan", "third")  # nothing is left to do
        assert PLANNER not in told("heuristic", "fourth")
    finally:
        code_folder.cache_clear()


def test_opening_a_robot_says_so_where_it_compiles(session_cache: Path, tmp_path: Path) -> None:
    def told(cache: Path, *words: str) -> list[str]:
        command = [sys.executable, "-m", "datagen.cli", *words]
        environment = os.environ | {"DATAGEN_CACHE": str(cache)}
        asked = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert asked.returncode == (2 if "none.toml" in words else 0), asked.stderr
        return asked.stderr.splitlines()

    assert len(told(tmp_path / "empty", "robot", "none.toml")) == 1
    assert told(session_cache, "robot", "panda") in ([], [KINEMATICS])  # another test may have compiled it
    # A part of the code is enough: all of it takes ten times as long.
    shutil.copytree(session_cache / "machine-code", tmp_path / "machine-code")
    (lost,) = tmp_path.glob("machine-code/*/*.contacts.hits_itself-*.code")
    lost.unlink()
    assert told(tmp_path, "robot", "panda") == [KINEMATICS]
    assert lost.exists() and told(tmp_path, "robot", "panda") == []
