"""The guide to exports: each program on it reads what the section's command writes."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from datagen import cli
from tests.conftest import REPOSITORY
from tests.small_runs import PER_SCENE, make_small_run
from tests.train.conftest import sim_run

__all__ = ["sim_run"]

PAGE = (REPOSITORY / "docs/guides/export.md").read_text("utf-8")
SECTIONS = [
    (text.partition("\n")[0], program)
    for text in PAGE.split("\n## ")
    for program in re.findall(r"```python\n(.*?)```", text, re.DOTALL)
]
FORMATS = {
    "Parquet": "parquet",
    "Hugging Face": "huggingface",
    "WebDataset": "webdataset",
    "LeRobot": "lerobot",
    "Frames": "frames",
    "Rerun": "rerun",
    "GLB": "glb",
    "A format of your own": "counted:steps",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_small_run(tmp_path_factory.mktemp("guide") / "RUN", 2 * PER_SCENE)


def test_every_format_has_a_program() -> None:
    assert [name for name, _ in SECTIONS] == list(FORMATS)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
@pytest.mark.parametrize(("name", "program"), SECTIONS, ids=[name for name, _ in SECTIONS])
def test_its_program_reads_the_export(
    name: str, program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    to = FORMATS[name]
    if to in ("lerobot", "rerun") and not find_spec(to):
        pytest.skip(f"{to} is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    if to == "counted:steps":
        Path("counted.py").write_text(program)
    source = request.getfixturevalue("sim_run" if to == "lerobot" else "run")
    assert cli.run(["export", str(source), "--to", to, "--out", "DIR", "--scenes", "0:2"]) == 0
    if to == "counted:steps":
        assert sorted(path.name for path in Path("DIR").iterdir()) == ["0.txt", "1.txt", "export.json"]
        return
    path = next((str(each) for each in Path("DIR").iterdir() if each.suffix in (".glb", ".rrd")), "")
    names: dict[str, object] = {"path": path}
    exec(program, names)
    assert len(names) > 3
