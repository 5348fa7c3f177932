"""Environments with the wheel and just those libraries that it asks for, linked from where the tests run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from importlib.metadata import distribution, metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from datagen.workers.extras import DISTRIBUTION
from tests.conftest import REPOSITORY, once

# Names of subpackages and of libraries.
OWN_FILES = ("train", "workers", "schemas", "cluster", "tests", "datagen", "numpy", "zarr")


@pytest.fixture(scope="session")
def wheel(shared_folder: Path) -> Path:
    """The wheel of this checkout, built once, in a folder whose name a shell would split."""
    folder = once(
        shared_folder / "wheel with spaces", lambda: build_wheel(shared_folder / "wheel with spaces")
    )
    (built,) = folder.glob("*.whl")
    return built


def build_wheel(folder: Path) -> None:
    """Build the wheel of this checkout from a copy of the sources, because a build leaves files there."""
    source = folder / "source"
    source.mkdir(parents=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source)
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(REPOSITORY / "datagen", source / "datagen", ignore=ignore)
    options = ["-q", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    command = [sys.executable, "-m", "pip", "wheel", *options, str(source)]
    subprocess.run(command, check=True, env={**os.environ, "PIP_NO_INDEX": "1"})


def install_wheel(wheel: Path, folder: Path) -> Path:
    """site-packages of a fresh environment in the folder that holds the wheel and no library.

    pip installs the wheel once; each environment is a copy, whose program names its own interpreter.
    """
    first = once(wheel.parent / "installed", lambda: _install(wheel, wheel.parent / "installed"))
    shutil.copytree(first, folder, symlinks=True)
    program = folder / "bin" / "datagen"
    program.write_text(program.read_text().replace(str(first), str(folder)))
    (site,) = folder.glob("lib/python*/site-packages")
    return site


def _install(wheel: Path, folder: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = str(folder / "bin" / "python")
    options = ["-q", "--no-deps", "--no-index", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "--python", python, "install", *options, str(wheel)]
    subprocess.run(command, check=True)


def own_files(folder: Path) -> None:
    """A user's own modules in the folder, which name themselves in its file `imported` when imported."""
    for name in OWN_FILES:
        (folder / f"{name}.py").write_text(f"open({str(folder / 'imported')!r}, 'a').write({name!r} + ' ')\n")


def link_libraries(site: Path, *extras: str) -> None:
    """Link what the wheel asks for with these extras, and what that asks for in turn."""
    libraries = Path(sysconfig.get_path("purelib"))
    assert set(extras) <= set(metadata(DISTRIBUTION).get_all("Provides-Extra", [])), (
        f"no such extra: {extras}"
    )
    names = list(_closure(DISTRIBUTION, extras, {}))
    if {"all", "sim"} & set(extras) and "mani-skill" not in names:
        names.append("mani-skill")  # where pip cannot, users install it by a command of its own
    done: dict[str, bool] = {}
    for name in names:
        if name != DISTRIBUTION:
            for file in distribution(name).files or ():
                if file.parts[0] != ".." and "__pycache__" not in file.parts:
                    _link(libraries, site, file.parts, done)


def _link(libraries: Path, site: Path, parts: tuple[str, ...], done: dict[str, bool]) -> None:
    """Link a file by its outermost folder that one distribution has alone: not a namespace as `google`.

    `done` has what is there already, by path: whether it is a link, which has all that is below it.
    """
    for depth in range(1, len(parts) + 1):
        path = "/".join(parts[:depth])
        if path not in done:
            source, target = libraries / path, site / path
            if not source.exists():
                return
            shared = (
                source.is_dir() and not (source / "__init__.py").exists() and source.suffix != ".dist-info"
            )
            target.mkdir() if shared else target.symlink_to(source)
            done[path] = not shared
        if done[path]:
            return


def _closure(name: str, extras: tuple[str, ...], seen: dict[str, set[str]]) -> Iterator[str]:
    """Names of a distribution and of all that it needs here with these extras."""
    known = seen.get(name)
    if known is not None and known >= set(extras):
        return
    seen[name] = (known or set()) | set(extras)
    if known is None:
        yield name
    for line in distribution(name).requires or ():
        needed = Requirement(line)
        if needed.marker is None or any(needed.marker.evaluate({"extra": e}) for e in (*extras, "")):
            yield from _closure(needed.name, tuple(needed.extras), seen)
