"""`make demo`: its commands are ours, its picture makes sense, and it ends with that and the next command."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
from PIL import Image

from datagen import cli
from tests.conftest import REPOSITORY
from tests.small_runs import arrays_of


def test_the_demo_ends_with_a_picture_of_bases_that_fit_and_with_the_next_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = subprocess.run(
        ["make", "--no-print-directory", "-n", "demo", f"DEMO={tmp_path}"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = made.stdout.splitlines()
    begin = next(k for k, line in enumerate(lines) if "datagen submit" in line)
    commands = [shlex.split(line)[1:] for line in lines[begin:] if not line.startswith("echo")]
    assert [words[0] for words in commands] == ["submit", "show"]
    for words in commands:
        assert cli.run([*words, *(["--workers", "0"] if words[0] == "submit" else [])]) == 0
    *_, picture, following = [shlex.split(line)[1] for line in lines if line.startswith("echo ")]
    path = picture.partition("The picture: ")[2]
    with Image.open(path) as image:
        assert image.width == 1320
    stored = arrays_of(tmp_path / "run")
    scene = stored["sample_scene_index"] == int(commands[1][commands[1].index("--scene") + 1])
    assert stored["base_is_clear"].all() and (stored["mount_distance_m"] <= stored["arm_reach_m"]).all()
    assert 0.2 < stored["label"][scene].mean() < 0.8  # both kinds of labels are in the picture
    capsys.readouterr()
    (command,) = re.findall(r"\S+/datagen (.+)$", following)
    assert cli.run(shlex.split(command)) == 0
    assert len(capsys.readouterr().out.splitlines()) <= 12
