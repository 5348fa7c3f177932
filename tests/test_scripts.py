"""The scripts that `make` calls before anything is installed."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
import tomllib
import venv
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packaging.requirements import Requirement

from datagen.workers.extras import DISTRIBUTION, EXTRAS

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["environment", "system_libraries"])
def test_they_need_only_the_standard_library(name: str) -> None:
    code = f"import runpy; runpy.run_path({str(SCRIPTS / (name + '.py'))!r}, run_name='loaded')"
    subprocess.run([sys.executable, "-I", "-S", "-c", code], check=True)


def test_the_stamp_follows_what_is_installed(tmp_path: Path) -> None:
    environment = load("environment")
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(environment.ROOT / name, tmp_path)
    environment.ROOT = tmp_path
    first = environment.fingerprint()
    assert environment.fingerprint() == first
    pyproject = tmp_path / "pyproject.toml"
    text = pyproject.read_text()
    pyproject.write_text(text + "\n[tool.another]\nlevel = 1\n")
    assert environment.fingerprint() == first
    pyproject.write_text(text.replace('"numpy>=2.0"', '"numpy>=2.1"'))
    second = environment.fingerprint()
    pyproject.write_text(text)
    constraints = tmp_path / "constraints.txt"
    constraints.write_text(constraints.read_text() + "extra==1\n")
    assert len({first, second, environment.fingerprint()}) == 3


def project() -> dict[str, Any]:
    return tomllib.loads((SCRIPTS.parent / "pyproject.toml").read_text())["project"]


def names_of(requirements: list[str]) -> set[str]:
    """The distributions of requirements, without those extras that name others of this package."""
    return {Requirement(line).name for line in requirements} - {DISTRIBUTION}


def test_every_dependency_is_pinned_and_the_base_brings_no_simulator_and_no_learner() -> None:
    lines = (SCRIPTS.parent / "constraints.txt").read_text().splitlines()
    pinned = {line.partition("==")[0] for line in lines if line and not line.startswith("#")}
    asked = [*project()["dependencies"], *chain(*project()["optional-dependencies"].values())]
    assert names_of(asked) <= pinned
    assert all(line.startswith("#") or "==" in line for line in lines if line)
    heavy = {pip_name for extra in EXTRAS.values() for pip_name in extra.brings.values()}
    assert not names_of(project()["dependencies"]) & heavy


def test_errors_and_the_doctor_know_the_extras_of_the_package() -> None:
    assert project()["name"] == DISTRIBUTION
    extras = project()["optional-dependencies"]
    assert extras.keys() - {"all", "dev", "docs"} == EXTRAS.keys()
    for name, extra in EXTRAS.items():
        asked = [line for line in extras[name] if ">= '3.13'" not in line]
        assert names_of(asked) == set(extra.brings.values()), name


def test_progress_tells_what_pip_does() -> None:
    progress = load("environment").Progress(1)
    assert progress.text(1) == "0 packages found"
    for line in (
        "Obtaining file:///x",
        "Collecting numpy==2.4.6 (from x)",
        "  Downloading http://h/numpy-2.whl (9 MB)",
    ):
        progress.read(line + "\n")
    assert progress.text(1) == "1 packages found, downloading numpy-2.whl (9 MB)"
    progress.read("Installing collected packages: numpy, zarr\n")
    assert progress.text(2) == "1 of 2 packages installed"


def test_an_environment_that_has_the_extras_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = load("environment")
    monkeypatch.setattr(environment, "STAMP", tmp_path / "stamp")
    monkeypatch.setattr(environment, "create", lambda: pytest.fail("made anew"))
    stamp = {"fingerprint": environment.fingerprint(), "extras": ["all", "dev", "docs"]}
    (tmp_path / "stamp").write_text(json.dumps(stamp))
    assert environment.main([]) == environment.main(["labels"]) == 0
    assert environment.installed_extras(stamp["fingerprint"]) == {"all", "dev", "docs"}
    for text in ("", "[]", '{"fingerprint": "other", "extras": ["all"]}'):
        (tmp_path / "stamp").write_text(text)
        assert environment.installed_extras(stamp["fingerprint"]) == set()


def output_of(*command: str | Path) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_in_its_activated_environment_the_interpreter_below_goes_on(tmp_path: Path) -> None:
    """`make` in an activated .venv: the same fingerprint, and nothing is removed under its feet."""
    script = tmp_path / "scripts" / "environment.py"
    script.parent.mkdir()
    shutil.copy(SCRIPTS / "environment.py", script)
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(SCRIPTS.parent / name, tmp_path)
    venv.create(tmp_path / ".venv", with_pip=False)
    python = tmp_path / ".venv" / "bin" / "python3"
    code = f"import runpy; print(runpy.run_path({str(script)!r})['fingerprint']())"
    below = output_of(python, "-c", "import sys; print(sys._base_executable)").strip()
    fingerprint = output_of(below, "-c", code).strip()
    stamp = {"fingerprint": fingerprint, "extras": ["labels"]}
    (tmp_path / ".venv" / "installed.json").write_text(json.dumps(stamp))
    assert output_of(python, script, "labels") == "" and python.exists()


def test_missing_libraries_are_found_and_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    libraries = load("system_libraries")
    monkeypatch.setattr(
        libraries,
        "LIBRARIES",
        {"libnothere.so.9": ("nothing", ("libnewname9", "libnothere9")), "libc.so.6": ("all", ("libc6",))},
    )
    assert libraries.missing_libraries() == ["libnothere.so.9"]
    monkeypatch.setattr(libraries, "_apt_knows", lambda package: package == "libnothere9")
    assert libraries.packages_for(["libnothere.so.9", "libnothere.so.9"]) == ["libnothere9"]
    monkeypatch.setattr(libraries, "_apt_knows", lambda package: True)
    assert libraries.packages_for(["libnothere.so.9"]) == ["libnewname9"]
    monkeypatch.setattr(libraries.os, "geteuid", lambda: 1000)
    assert "sudo apt-get install -y --no-install-recommends a b" in libraries.install_command(["a", "b"])
