"""The scripts that `make` calls before anything is installed."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

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


def test_every_dependency_is_pinned() -> None:
    import tomllib

    root = SCRIPTS.parent
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    lines = (root / "constraints.txt").read_text().splitlines()
    pinned = {line.partition("==")[0] for line in lines if line and not line.startswith("#")}
    asked = [
        *project["dependencies"],
        *(d for extra in project["optional-dependencies"].values() for d in extra),
    ]
    names = {d.partition(">=")[0].partition("[")[0] for d in asked} - {"datagen"}
    assert names <= pinned
    assert all(line.startswith("#") or "==" in line for line in lines if line)


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
