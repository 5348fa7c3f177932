"""`datagen assets check`: what a folder gives, before a job; and runs on folders of meshes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen import cli
from tests.datagen.test_surveys import six_houses
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, OPEN_TOPS, arrays_of, submit_arguments
from tests.workers.houses.test_habitat import write_hssd
from tests.workers.objects.folder_files import box, write_as

KINDS = ("obj", "ply", "stl", "mm.stl", "glb", "y.obj", "urdf", "sdf", "mjcf", "msh")


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten boxes, one in each format, and a file that is none."""
    folder = tmp_path_factory.mktemp("my objects")
    for k, kind in enumerate(KINDS):
        sides_m = 0.03 + 0.002 * k, 0.05 + 0.003 * k, 0.06 + 0.005 * k
        write_as(kind, box(*sides_m), folder / f"box {k}", mass_kg=500 * float(np.prod(sides_m)))
    (folder / "broken.obj").write_text("v 0 0 0\n")
    (folder / "LICENSE.txt").write_text("CC0")
    return folder


def test_objects_are_listed_and_drawn(
    meshes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "sheet.png"
    assert cli.run(["assets", "check", str(meshes), "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    for words in (
        "box 3",
        "3.6 x 5.9 x 7.5",
        "in millimetres",
        "11 read, 1 unusable",
        "broken: the mesh has no",
    ):
        assert words in printed
    assert "licences: LICENSE.txt" in printed
    sheet = np.asarray(Image.open(picture))
    width = sheet.shape[1] // 7
    drawn = [
        len(np.unique(sheet[20:160, k * width : (k + 1) * width].reshape(-1, 3), axis=0)) for k in range(7)
    ]
    assert min(drawn) > 3, "an object, its plate and the paper"
    assert cli.run(["assets", "check", f"folder:{meshes}", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["read"] == 11 and list(told["unusable"]) == ["broken"] and len(told["objects"]) == 10
    assert told["objects"][3]["notes"]["in millimetres"] == "it spans 75"


def test_houses_are_examined_as_submit_examines_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    houses = six_houses(tmp_path / "houses")
    assert cli.run(["assets", "check", str(houses)]) == 0
    printed = capsys.readouterr().out
    assert f"procthor:{houses}: 6 read, 4 unusable" in printed and "  broken: has no rooms" in printed
    refused(["assets", "check", str(houses), "--picture", str(tmp_path / "a.png")], capsys, "of objects")


def test_a_scene_that_is_corrected_is_examined_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_hssd(tmp_path) / "scenes/102344022.scene_instance.json"
    text = scene.read_text()
    # As long as before: the digest of the source knows names and sizes alone.
    scene.write_text(text.replace('"rotation": [1, 0, 0, 0]', '"rotation": [9, 9, 9, 9]', 1))
    assert cli.run(["assets", "check", str(tmp_path)]) == 0
    assert "1 unusable" in capsys.readouterr().out
    scene.write_text(text)
    assert cli.run(["assets", "check", str(tmp_path)]) == 0
    assert "unusable" not in capsys.readouterr().out


@pytest.mark.parametrize("given", ["no/such/folder", "builtin", "procthor:no/such", "README.md"])
def test_what_is_no_folder_is_refused(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    refused(["assets", "check", given], capsys)


def test_a_folder_without_usable_objects_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.stl").write_bytes(b"solid\n")
    refused(["assets", "check", str(tmp_path)], capsys, "has no usable object", "a.stl")


def test_heuristic_labels_of_a_folder_of_meshes(
    meshes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert cli.run(submit_arguments(run, 24, "--objects", f"folder:{meshes}")) == 0
    assert "folder objects: 11 read, 1 unusable (the mesh has no faces 1)" in capsys.readouterr().err
    names = arrays_of(run)["object_name"].tolist()
    assert all(len(set(row)) == 7 for row in names)
    assert {name for row in names for name in row} <= {f"box {k}" for k in range(10)}
    assert cli.run(["verify", str(run), "--replay", "1"]) == 0


def test_few_objects_stand_several_times_in_a_scene(meshes: Path, tmp_path: Path) -> None:
    few = tmp_path / "few"
    for k in (1, 2):
        write_as("obj", box(0.03, 0.04 + k / 100, 0.08), few / f"box {k}")
    run = tmp_path / "run"
    assert cli.run(submit_arguments(run, 8, "--objects", f"folder:{few}")) == 0
    names = arrays_of(run)["object_name"].tolist()
    assert {name for row in names for name in row} == {"box 1", "box 2"}


@pytest.mark.slow
@needs_sim
def test_plan_labels_of_a_folder_of_meshes(meshes: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    line = submit_arguments(run, 16, "--objects", f"folder:{meshes}", config=CONFIG + OPEN_TOPS)
    line[1] = "plan"
    assert cli.run([*line, "--candidates", "in-range"]) == 0
    assert 0 < arrays_of(run)["label"].sum() < 16
