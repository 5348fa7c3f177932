"""The guide "Your own robot": its file and its commands are executed, and its table has every key."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from pydantic import BaseModel

from datagen import cli
from datagen.schemas.run import Run
from datagen.workers.robots.robot_file import PoseKeys, RobotFile, TcpKeys
from tests.conftest import REPOSITORY
from tests.sim_extra import needs_robots, needs_sim

PAGE = (REPOSITORY / "docs/guides/your-own-robot.md").read_text("utf-8")


def keys_of(model: type[BaseModel], prefix: str = "") -> set[str]:
    """Dotted names of all keys; poses count as one."""
    found = set[str]()
    for name, field in model.model_fields.items():
        parts = [field.annotation, *getattr(field.annotation, "__args__", ())]
        below = [p for p in parts if isinstance(p, type) and issubclass(p, BaseModel)]
        if below and below[0] not in (PoseKeys, TcpKeys):
            found |= keys_of(below[0], f"{prefix}{name}.")
        else:
            found.add(prefix + name)
    return found


def test_the_table_has_every_key_and_no_other() -> None:
    rows = re.findall(r"^\| (`.*?`) \|", PAGE, re.MULTILINE)
    assert {key for row in rows for key in re.findall(r"`([^`]+)`", row)} == keys_of(RobotFile)


@needs_sim
@needs_robots
@pytest.mark.parametrize("verb", ["robot", pytest.param("submit", marks=pytest.mark.slow)])
def test_the_steps_work_as_written(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in re.findall(r"```toml file=(\S+)\n(.*?)```", PAGE, re.DOTALL):
        Path(name).write_text(text)
    (command,) = re.findall(rf"^datagen {verb} .*$", PAGE, re.MULTILINE)
    words = shlex.split(command)[1:]
    assert cli.run([*words, *(["--workers", "0"] if verb == "submit" else [])]) == 0
    if verb == "robot":
        assert capsys.readouterr().out.startswith("robot ur10") and Path("ur10.png").stat().st_size > 10_000
        return
    run = Run.open("runs/ur10")
    arm = run.manifest.spec.arm
    assert arm is not None and arm.robot == "ur10" and arm.robot_digest and arm.joints == 6
    assert run.manifest.sources["robot"] == str(tmp_path / "ur10.toml")
    # A file that moved is named; another one is refused.
    Path("elsewhere").mkdir()
    moved = Path("ur10.toml").rename("elsewhere/ur10.toml")
    assert cli.run(["resume", "runs/ur10", "--n", "75", "--workers", "0"]) == 2
    assert "ur10.toml" in capsys.readouterr().err
    assert cli.run(["resume", "runs/ur10", "--n", "75", "--workers", "0", "--robot", str(moved)]) == 0
    moved.write_text(moved.read_text() + 'name = "other"\n')
    assert cli.run(["resume", "runs/ur10", "--n", "90", "--workers", "0", "--robot", str(moved)]) == 2
    assert "but the run was made with ur10" in capsys.readouterr().err.replace("\n", " ")
