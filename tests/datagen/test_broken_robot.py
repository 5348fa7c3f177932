"""A robot whose files are broken is refused before a run exists, and before any shard is tried."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.schemas.run import Run
from tests.refusals import without_phases
from tests.sim_extra import needs_sim
from tests.small_runs import PER_SCENE, make_small_run

pytestmark = needs_sim


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Of a process that finds a ManiSkill whose Panda is cut off in the middle."""
    from datagen.workers.robots.resources import package_folders

    robots = tmp_path / "site" / "mani_skill" / "assets" / "robots"
    (robots / "panda").mkdir(parents=True)
    (tmp_path / "site/mani_skill/__init__.py").touch()
    source = next(package_folders("mani_skill")) / "assets/robots/panda"
    (robots / "panda/franka_description").symlink_to(source / "franka_description")
    text = (source / "panda_v2.urdf").read_text()
    (robots / "panda/panda_v2.urdf").write_text(text[: len(text) // 2])
    return {**os.environ, "PYTHONPATH": str(tmp_path / "site")}


def test_it_is_refused_for_new_and_for_stored_scenes_and_leaves_no_run(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    source, out = make_small_run(tmp_path / "source", PER_SCENE, "--robot", "panda"), tmp_path / "run"
    for kind, more in (("plan", []), ("sim", ["--scenes-from", str(source)])):
        command = [sys.executable, "-m", "datagen.cli", "submit", kind, "--n", "8", "--out", str(out)]
        asked = subprocess.run(
            [*command, "--robot", "panda", "--workers", "0", *more],
            env=environment, capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        assert asked.returncode == 2, asked.stderr
        (line,) = without_phases(asked.stderr)
        assert "panda_v2.urdf: is not XML" in line and "install its package again" in line
        assert not out.exists()
    assert Run.open(source).committed()  # heuristic labels of that robot's candidates need no file of it
