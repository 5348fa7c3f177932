"""The built wheel as a stranger has it: one import name, used from a folder full of files with our names."""

from __future__ import annotations

import json
import os
import subprocess
import zipfile
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.linked_environments import install_wheel, link_libraries, own_files, wheel
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG
from tests.train.prediction.seen_scenes import draw_seen, write_frame

__all__ = ["wheel"]
FEW_GRASPS = "[arm.grasps]\nper_object = 40\nper_scene = 10\n"
MODEL = ("--model-config", "width=16", "--model-config", "embedding=32", "--model-config", "n_points=64")
# Commands in one process, which imports its libraries once; the first that fails ends it.
SEVERAL = """
import json, sys
from datagen import cli

if __name__ == "__main__":
    for words in json.loads(sys.argv[1]):
        code = cli.run(words)
        if code != 0:
            sys.exit(f"{words}: exit code {code}")
"""


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `bin` folder of a fresh environment with the wheel and all libraries of this environment."""
    folder = tmp_path_factory.mktemp("environment") / "venv"
    link_libraries(install_wheel(wheel, folder), "all")
    return folder / "bin"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder, whose own modules say so when anything imports them."""
    folder = tmp_path_factory.mktemp("user")
    own_files(folder)
    return folder


def test_a_wheel_adds_one_import_name(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name.split("/")[0] for name in archive.namelist()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"datagen"}


def test_a_wheel_has_the_benchmark_the_model_and_its_frame(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    released = {name: size for name, size in sizes.items() if name.startswith("datagen/released/")}
    for folder in ("released", "benchmark"):
        for path in (REPOSITORY / "datagen" / folder).rglob("*"):
            if path.is_file() and path.suffix != ".pyc":
                assert sizes[str(path.relative_to(REPOSITORY))] == path.stat().st_size
    assert sum(released.values()) < 5_500_000


@needs_sim
def test_labels_training_and_prediction_beside_a_users_files(installed: Path, folder: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "RAY_"))}
    environment["OMP_NUM_THREADS"] = "1"
    several = installed / "several"  # as `datagen` is, whose folder comes first in the path of its imports
    several.write_text(SEVERAL)

    def run(*command: str | Path) -> None:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{' '.join(map(str, command))}: {done.stderr}"

    (folder / "small.toml").write_text(CONFIG)
    (folder / "plan.toml").write_text(CONFIG + FEW_GRASPS)
    small = ("--n", "48", "--candidates-per-scene", "8")
    plan = ("--split", "test", "--candidates", "in-range", "--config", "plan.toml")
    run(installed / "datagen", "submit", "plan", "--out", "plan", *plan, *small)  # on Ray
    heuristic = ("submit", "heuristic", "--workers", "0", "--config", "small.toml")
    robot = ("--base-height", "0.7", "--reach", "0.9", "--robot-camera-height", "1.2")
    write_frame(folder / "frame", draw_seen(0))
    commands = [
        (*heuristic, "--out", "run", "--split", "train", *small),
        (*heuristic, "--out", "val", "--split", "val", "--n", "8", "--candidates-per-scene", "8"),
        ("show", "run", "--scene", "0", "--out", "scene.png"),
        ("train", "stage1", "run", "--val", "val", "--out", "a.ckpt", "--epochs", "1", *MODEL),
        ("evaluate", "a.ckpt", "plan", "--baselines", "none", "--out", "page.html"),
        ("predict", "a.ckpt", "--frame", "frame", *robot, "--out", "heat.png"),
        ("predict", "--demo"),
    ]
    run(installed / "python", several, json.dumps(commands))
    assert {"scene.png", "page.html", "heat.png", "demo.png", "demo.html"} <= {
        path.name for path in folder.iterdir()
    }
    assert not (folder / "imported").exists(), (folder / "imported").read_text()
