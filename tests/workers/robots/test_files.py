"""The files of robots: written when asked for, shared by a family, dropped when unused, written again."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen.workers.robots.panda import PANDA_SCALED
from datagen.workers.robots.robot import Robot
from datagen.workers.robots.robot_files import RobotFiles
from datagen.workers.robots.urdf import read_urdf


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "robots"


def arm(reach_m: float) -> Robot:
    return Robot(PANDA_SCALED, reach_m, 0.8)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} - {".lock"}


def test_opening_writes_nothing(folder: Path) -> None:
    robot = arm(0.7)
    assert not folder.exists()
    urdf = robot.urdf
    assert urdf.is_file() and urdf.parent == folder and urdf.with_suffix(".srdf").is_file()
    assert robot.at_height(0.5).urdf == robot.urdf == urdf


def test_a_family_shares_its_parts(folder: Path) -> None:
    for reach_m in (0.55, 0.7, 0.9):
        assert arm(reach_m).urdf.is_file()
    found = names(folder)
    assert sum(name.endswith(".stl") for name in found) == len(found) - 6
    before = len(found)
    assert arm(0.8).urdf.is_file()
    assert len(names(folder)) == before + 2


@pytest.mark.parametrize("reach_m", [0.35, 0.8])
def test_parts_in_files_are_those_of_the_links(reach_m: float) -> None:
    robot = arm(reach_m)
    tree = read_urdf(robot.urdf)
    for name, parts in zip(robot.link_names, robot.link_parts_m, strict=True):
        shapes = tree.link(name).collisions
        assert len(shapes) == len(parts)
        for shape, part in zip(shapes, parts, strict=True):
            assert shape.mesh is not None
            mesh = trimesh.load_mesh(shape.mesh)
            assert mesh.is_watertight and mesh.volume > 0
            corners = np.asarray(mesh.vertices) * shape.scale
            gaps = np.linalg.norm(corners[:, None] - part[None], axis=2)
            assert gaps.min(axis=1).max() < 1e-6
            np.testing.assert_allclose(corners.max(axis=0), part.max(axis=0), atol=1e-6)
            np.testing.assert_allclose(corners.min(axis=0), part.min(axis=0), atol=1e-6)


def test_what_is_asked_for_again_is_marked_as_used_and_repaired(folder: Path) -> None:
    robot = arm(0.7)
    urdf = robot.urdf
    whole = {name: (folder / name).read_bytes() for name in names(folder)}
    for name in whole:
        os.utime(folder / name, (1, 1))
    assert robot.urdf == urdf
    assert all((folder / name).stat().st_mtime > time.time() - 3600 for name in whole)
    urdf.unlink()
    next(folder.glob("*.stl")).unlink()
    next(folder.glob("*.srdf")).write_text("")
    assert robot.urdf == urdf
    assert {name: (folder / name).read_bytes() for name in names(folder)} == whole


def test_only_what_is_long_unused_is_dropped(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("datagen.workers.robots.robot_files._MOST_FILES", 20)
    monkeypatch.setattr("datagen.workers.robots.robot_files._WRITTEN_BETWEEN_PRUNINGS", 1)
    robots = [arm(reach_m) for reach_m in np.linspace(0.6, 0.9, 8)]
    for robot in robots:
        assert robot.urdf.is_file()
    before = names(folder)
    assert len(before) > 20
    old = [path for robot in robots[:6] for path in (robot.urdf, robot.urdf.with_suffix(".srdf"))]
    for path in old:
        os.utime(path, (1, 1))
    new = arm(0.65).urdf
    # What is left is more than the folder should have, and all of it is in use.
    assert names(folder) == before - {path.name for path in old} | {new.name, f"{new.stem}.srdf"}
    assert robots[0].urdf.is_file()  # written again


_CHILD = """
import os, sys
from datagen.workers.content_cache import alone_in, drop_unused
from datagen.workers.robots import robot_files
from datagen.workers.robots.robot import Robot
from datagen.workers.robots.panda import PANDA_SCALED
from datagen.workers.robots.urdf import read_urdf
robots = [Robot(PANDA_SCALED, reach_m, 0.8) for reach_m in (0.6, *map(float, sys.argv[1:]))]
for k in range(7):
    if k:
        with alone_in(urdf.parent):
            drop_unused(urdf.parent, 4, 3600)
    urdf = robots[k % 3].urdf
    tree = read_urdf(urdf)
    assert urdf.with_suffix(".srdf").is_file()
    for link in tree.links.values():
        assert all(shape.mesh.is_file() for shape in link.collisions)
    if k % 3:  # more than an hour passes for this process's own
        os.utime(urdf, (1, 1))
        os.utime(urdf.with_suffix(".srdf"), (1, 1))
print(robot_files.RobotFiles._n_written)
"""


def test_processes_never_miss_a_file_that_they_asked_for(folder: Path) -> None:
    # The robots of one process are dropped before they are asked for again; the one of both is in use.
    started = [
        subprocess.Popen([sys.executable, "-c", _CHILD, *own], stdout=subprocess.PIPE, text=True)
        for own in (("0.62", "0.64"), ("0.72", "0.74"))
    ]
    printed = [process.communicate(timeout=600)[0] for process in started]
    assert [process.returncode for process in started] == [0, 0]
    assert sum(int(count) for count in printed) > 6


def test_a_cache_that_cannot_be_written_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "file"))
    robot = arm(0.7)
    urdf = robot.urdf
    assert urdf.is_file() and tmp_path not in urdf.parents
    assert robot.urdf == urdf


def test_a_full_cache_costs_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = RobotFiles._write

    def full(files: RobotFiles, into: Path) -> tuple[Path, ...]:
        if into == folder:
            raise OSError(28, "No space left on device")
        return write(files, into)

    monkeypatch.setattr(RobotFiles, "_write", full)
    assert arm(0.7).urdf.is_file()
