"""Fixtures of the command line's tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from datagen import cli
from tests.small_runs import CONFIG, PER_SCENE, make_small_run

# Long arms, so that some candidates can be reached; few grasps, which are quickly found.
LONG_ARMS = "[candidates]\narm_reach_m = {low = 0.9, high = 1.0}\nrobots_per_scene = 1\n"
FEW_GRASPS = "[arm.grasps]\nper_object = 40\nper_scene = 10\n"
PAIRED = 12


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three scenes in as many shards. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("finished") / "run", 3 * PER_SCENE)


@pytest.fixture(scope="session")
def paired(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs of the same candidates of one scene by label source; `disturbed` executes each plan twice."""
    folder = tmp_path_factory.mktemp("paired")
    choices = ["--candidates", "in-range", "--seed", "5"]
    made = {"heuristic": folder / "heuristic"}
    make_small_run(made["heuristic"], PAIRED, *choices, config=CONFIG + LONG_ARMS, per_scene=PAIRED)
    (folder / "arm.toml").write_text(FEW_GRASPS)
    for name, *more in (("plan",), ("sim",), ("disturbed", "--perturb", "2")):
        made[name] = folder / name
        assert cli.run([
            "submit", "sim" if more else name, "--n", str(PAIRED), "--out", str(made[name]), "--workers", "0",
            "--scenes-from", str(made["heuristic"]), "--config", str(folder / "arm.toml"), *more,
        ]) == 0  # fmt: skip
    return made


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """The finished run, or the one of that name in the test's file, to be changed; its links are kept."""
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture
def places(tmp_path: Path) -> dict[str, Path]:
    """Folders and files that arguments name in braces."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("text")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("text")
    names = ("out", "empty", "file", "foreign", "missing")
    return {name: tmp_path / name for name in names}
