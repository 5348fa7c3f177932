"""The commands of docs/tutorials/make-labels.md do what the page shows, at small size."""

from __future__ import annotations

import importlib.util
import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from datagen import cli
from tests.conftest import REPOSITORY
from tests.small_runs import json_of

pytestmark = pytest.mark.slow

# Small runs in the command's own process: starting Ray eight times would cost more than the labels.
SMALL = {
    "--n 6000 --out": "--n 60 --workers 0 --out",
    "--n 6000 --houses": "--n 120 --seed 2 --workers 0 --houses",
    "datagen resume": "datagen resume --workers 0",
    "--replay 4": "--replay 2",
    # The commands are what is tried here, on every machine; real houses and objects have tests of their own.
    "procthor:$ASSETS/procthor": "builtin",
    "ycb:$ASSETS/ycb": "builtin",
}


def _script() -> ModuleType:
    path = REPOSITORY / "scripts" / "console_page.py"
    spec = importlib.util.spec_from_file_location("console_page", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["console_page"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(params=["folder", "s3"])
def runs(request: pytest.FixtureRequest) -> str:
    if request.param == "folder":
        return "."
    return request.getfixturevalue("bucket") + "/page"


def in_this_process(command: Any, capture: pytest.CaptureFixture[str]) -> Any:
    """A line that calls `datagen` alone, without a shell and the imports of a new process."""
    capture.readouterr()
    program, *arguments = shlex.split(os.path.expandvars(command.text))
    assert program == "datagen"
    code = cli.run(arguments)
    told = capture.readouterr()
    errors = [line for line in told.err.splitlines() if line.startswith("error:")]
    here = str(Path.cwd())
    output = tuple(line.rstrip().replace(here, ".") for line in [*told.out.splitlines(), *errors])
    return replace(command, output=output, exit_code=code)


def test_the_page_of_runs(
    runs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUNS", runs)
    script = _script()
    commands = script.commands_of((REPOSITORY / "docs" / "tutorials" / "make-labels.md").read_text())
    assert len(commands) >= 8
    environment = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(REPOSITORY),
        "PYTHONWARNINGS": "",
    }
    for command in commands:
        text = command.text
        for large, small in SMALL.items():
            text = text.replace(large, small)
        if "kill -9" in text:  # between the second attempt and its end, for certain
            text = text.replace("datagen submit", "python -m tests.datagen.stopping_submit submit", 1)
        asked = replace(command, lines=(text,))
        alone = text.startswith("datagen ") and len(command.lines) == 1
        done = in_this_process(asked, capsys) if alone else script.run_command(asked, tmp_path, environment)
        output = tuple(line.replace(runs, ".") for line in done.output)  # the page was filled in on a folder
        told = "\n".join(output)
        assert done.exit_code == command.exit_code, f"{text}\n{told}"
        missing = set(script.labels_of(command.output)) - set(script.labels_of(output))
        assert not missing, f"{text}\nno longer prints {missing}:\n{told}"
    assert len(json_of(capsys, ["status", f"{runs}/both"])["parts"]) == 2
