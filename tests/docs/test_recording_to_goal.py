"""The tutorial from a recording to a goal: its commands and its program are executed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml

from datagen import cli
from tests.conftest import REPOSITORY
from tests.train.prediction.recorded_scenes import record, write
from tests.train.prediction.seen_scenes import draw_seen

PAGE = (REPOSITORY / "docs/tutorials/from-recording-to-goal.md").read_text("utf-8")


def test_the_steps_lead_to_a_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    seen = draw_seen(0)
    write(tmp_path, record(seen), as_file=False).rename("REC")
    v, u = np.argwhere(seen.frame.body == 1).mean(axis=0).round().astype(int)
    (command,) = re.findall(r"^datagen predict .*$", PAGE, re.MULTILINE)
    words = [f"{u},{v}" if word == "160,120" else word for word in shlex.split(command)[1:]]
    assert cli.run(words) == 0
    assert Path("answer.png").stat().st_size > 10_000
    goal = yaml.safe_load(Path("goal.yaml").read_text())
    assert goal["goal"]["header"]["frame_id"] == "map" and goal["level"] in ("good", "doubtful")
    program = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0]
    capsys.readouterr()
    exec(program, {})
    assert capsys.readouterr().out.startswith(f"{goal['level']} map {{'x': ")
