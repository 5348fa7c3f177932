"""Names of entries outside the package: what they open, and that only the user can have them imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import datagen
from datagen import cli
from datagen.schemas.errors import InputError
from datagen.train.models import build_model
from datagen.workers.houses import open_houses
from datagen.workers.labels import load_label_source
from datagen.workers.objects import open_objects
from datagen.workers.registry import ALLOWED, allow
from tests.small_runs import arrays_of, submit_arguments

MODULE = """
from dataclasses import replace
from datagen.train.models.shared import SharedModel
from datagen.workers.houses import open_houses
from datagen.workers.labels.heuristic_source import HEURISTIC
from datagen.workers.objects import open_objects

SOURCE = replace(HEURISTIC, name="own labels")

def open_rooms(text):
    return open_houses(f"builtin:{text or 3}")

def open_things(text):
    return open_objects("builtin")

def model(config):
    return SharedModel(config)
"""


@pytest.fixture(autouse=True)
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path with the module `own_code`; nothing is allowed yet."""
    (tmp_path / "own_code.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(ALLOWED, "")
    monkeypatch.delitem(sys.modules, "own_code", raising=False)
    return tmp_path


ENTRIES = {
    "own_code:open_rooms:5": lambda ref: len(open_houses(ref).house_ids()) == 5,
    "own_code:open_things": lambda ref: len(open_objects(ref).names()) == 58,
    "own_code:SOURCE": lambda name: load_label_source(name).name == "own labels",
    "own_code:model": lambda name: bool(build_model(name, {"width": 32, "embedding": 32})),
}


@pytest.mark.parametrize("name", ENTRIES)
def test_a_name_imports_nothing_until_the_user_allows_it(name: str) -> None:
    with pytest.raises(InputError, match=f"Set {ALLOWED}=own_code"):
        ENTRIES[name](name)
    assert "own_code" not in sys.modules
    allow(["--option=" + name])
    assert ENTRIES[name](name)


def test_python_code_allows_what_it_names_in_a_registry() -> None:
    assert len(datagen.houses["own_code:open_rooms:4"].house_ids()) == 4
    assert "own_code:open_rooms" not in list(datagen.houses)


@pytest.mark.parametrize("name", ["procthr:assets", "own_code:nothing", "no_code:open"])
def test_what_cannot_be_imported_is_named(name: str) -> None:
    allow([name])
    with pytest.raises(InputError, match=r"procthr|own_code has no nothing|no_code"):
        open_houses(name)


def test_a_run_of_own_houses_objects_and_labels(outside: Path) -> None:
    run = outside / "run"
    sources = ["--houses", "own_code:open_rooms", "--objects", "own_code:open_things"]
    words = submit_arguments(run, 32, *sources)
    assert cli.run(["submit", "own_code:SOURCE", *words[2:]]) == 0
    assert set(arrays_of(run)["label_source"]) == {"own labels"}
    os.environ[ALLOWED] = ""
    assert cli.run(["status", str(run)]) == 0  # reading imports nothing


@pytest.mark.slow
def test_workers_of_ray_import_own_code(outside: Path) -> None:
    words = ["submit", "heuristic", "--n", "120", "--houses", "own_code:open_rooms", "--workers", "2"]
    done = subprocess.run(
        [sys.executable, "-m", "datagen.cli", *words, "--out", str(outside / "run")],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(outside), str(Path.cwd())])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
