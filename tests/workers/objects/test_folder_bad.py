"""Damaged and hostile files in a folder of objects: each is skipped with its reason, in one line."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
import trimesh

from datagen.schemas.errors import InputError
from datagen.workers.objects import decomposition, open_objects, surfaces
from datagen.workers.objects.folder import FolderObjects
from tests.workers.objects.folder_files import box, cup, write_as

STL = box(0.04, 0.05, 0.06).export(file_type="stl")
PLY = box(0.04, 0.05, 0.06).export(file_type="ply", encoding="ascii")
GLB = box(0.04, 0.05, 0.06).export(file_type="glb")
GLTF = box(0.04, 0.05, 0.06).export(file_type="gltf")["model.gltf"]
URDF = '<robot name="a"><link name="l"><visual><geometry>{}</geometry></visual></link>{}</robot>'
BOX = '<box size="0.04 0.05 0.06"/>'
BALL = '<geom size="0.03"/>'
MJCF = "<mujoco>{}<worldbody><body>{}</body></worldbody></mujoco>"
SDF = (
    "<sdf version='1.6'><model name='a'><link name='l'><visual name='v'><geometry>{}</geometry></visual>"
    "</link>{}</model></sdf>"
)
INCLUDE = "<include><uri>model://table</uri></include>"
POSED = "<link name='m'><pose relative_to='{}'>0 0 0 0 0 0</pose></link>"
OF_MESH = '<asset><mesh name="m" file="a.msh"/></asset>'
MOVED_MESH = '<asset><mesh name="m" file="a.msh" refpos="0 0 1"/></asset>'
BODY = f"</body><body><freejoint/>{BALL}"
BOMB = '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
JOINT = '<link name="m"/><joint name="j" type="{}"><parent link="l"/><child link="m"/></joint>'


def _ply(old: bytes, new: bytes) -> bytes:
    changed = PLY.replace(old, new, 1)
    assert changed != PLY
    return changed


FACE = PLY.strip().splitlines()[-1]
VERTEX = PLY[PLY.index(b"end_header\n") + 11 :].splitlines()[0]
HUGE_STL = bytes(80) + struct.pack("<I", 2**32 - 1)
BAD: dict[str, tuple[str, str | bytes, str]] = {
    "empty": ("a.obj", "", "no faces"),
    "a web page": ("a.obj", "<!DOCTYPE html>", "web page"),
    "nan": ("a.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
    "obj index": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "refers to vertex 9"),
    "stl cut off": ("a.stl", STL[: len(STL) // 2], "no triangles"),
    "stl of a million million faces": ("a.stl", HUGE_STL, "no triangles"),
    "ply nan": ("a.ply", _ply(VERTEX, b"nan 0 0"), "not finite"),
    "ply index": ("a.ply", _ply(FACE, b"3 0 1 99"), ""),
    "ply claims too much": ("a.ply", _ply(b"vertex 8", b"vertex 99999999999"), ""),
    "ply without faces": ("a.ply", _ply(b"element face 12", b"element face 0"), ""),
    "glb cut off": ("a.glb", GLB[: len(GLB) // 2], ""),
    "glb of another kind": ("a.glb", b"PK\x03\x04" + bytes(100), "zip file"),
    "gltf cut off": ("a.gltf", GLTF[: len(GLTF) // 2], ""),
    "gltf of another kind": ("a.gltf", GLB, "binary glTF file"),
    "gltf without its buffer": ("a.gltf", GLTF, "cannot be read"),
    "gltf of a buffer outside": ("a.gltf", GLTF.replace(b"gltf_buffer_0", b"../../x"), "not inside"),
    "msh header": ("a.xml", MJCF.format(OF_MESH, '<geom type="mesh" mesh="m"/>'), "a.msh"),
    "flat": ("a.obj", "v 0 0 0\nv .1 0 0\nv .1 .1 0\nv 0 .1 0\nf 1 2 3\nf 1 3 4\n", "no volume"),
    "too small": ("a.stl", box(0.001, 0.001, 0.001).export(file_type="stl"), "its scale in objects.csv"),
    "of kilometres": ("a.stl", box(5000, 5000, 5000).export(file_type="stl"), "wrong size"),
    "urdf bomb": ("a.urdf", BOMB + URDF.format(BOX, ""), "document type"),
    "urdf bomb in UTF-16": ("a.urdf", (BOMB + URDF.format(BOX, "")).encode("utf-16"), "document type"),
    "sdf bomb": ("a.sdf", BOMB + SDF.format("<box><size>1 1 1</size></box>", ""), "document type"),
    "mjcf bomb": ("a.xml", BOMB + MJCF.format("", '<geom type="box" size="1 1 1"/>'), "document type"),
    "not xml": ("a.urdf", "<robot", "not XML"),
    "urdf joint": ("a.urdf", URDF.format(BOX, JOINT.format("continuous")), "not rigid"),
    "urdf mesh outside": ("a.urdf", URDF.format('<mesh filename="/etc/passwd"/>', ""), "not inside"),
    "urdf mesh above": ("a.urdf", URDF.format('<mesh filename="../../../x.stl"/>', ""), "not inside"),
    "urdf mesh with NUL": ("a.urdf", URDF.format('<mesh filename="&#1;"/>', ""), "not XML"),
    "urdf mesh missing": ("a.urdf", URDF.format('<mesh filename="x.stl"/>', ""), "cannot be read"),
    "urdf without shapes": ("a.urdf", '<robot name="a"><link name="l"/></robot>', "no shape"),
    "sdf of two models": ("a.sdf", SDF.format("", "<model name='b'/>"), "one model"),
    "sdf of gazebo 1.0": ("a.sdf", "<gazebo version='1.2'><model name='a'/></gazebo>", "is not <sdf>"),
    "sdf joint": ("a.sdf", SDF.format("", "<joint name='j' type='revolute'/>"), "not rigid"),
    "sdf without size": ("a.sdf", SDF.format("<box/>", ""), "finite numbers"),
    "sdf of a cone": ("a.sdf", SDF.format("<cone><radius>1</radius></cone>", ""), "cone"),
    "sdf that includes": ("a.sdf", SDF.format("<sphere><radius>0.03</radius></sphere>", INCLUDE), "include"),
    "sdf pose of nothing": ("a.sdf", SDF.format("", POSED.format("x")), "relative_to x"),
    "sdf pose of itself": ("a.sdf", SDF.format("", POSED.format("m")), "relative_to m"),
    "mjcf joint": ("a.xml", MJCF.format("", '<joint name="h"/><geom size="0.03"/>'), "not rigid"),
    "mjcf without mesh": ("a.xml", MJCF.format("", '<geom type="mesh" mesh="m"/>'), "not among the assets"),
    "mjcf of planes": ("a.xml", MJCF.format("", '<geom type="plane" size="1 1 1"/>'), "no shape"),
    "mjcf without size": ("a.xml", MJCF.format("", '<geom type="box" size="1 nan 1"/>'), "finite numbers"),
    "mjcf of negative size": ("a.xml", MJCF.format("", '<geom type="box" size="0.1 -1 0.1"/>'), "no volume"),
    "mjcf that is not read": ("a.xml", MJCF.format("", '<geom size="0.03" zaxis="1 0 0"/>'), "zaxis"),
    "mjcf replicates": ("a.xml", MJCF.format("", f'<replicate count="3">{BALL}</replicate>'), "replicate"),
    "mjcf of two bodies": ("a.xml", MJCF.format("", 2 * BODY), "not one rigid object"),
    "mjcf moves a mesh": ("a.xml", MJCF.format(MOVED_MESH, '<geom type="mesh" mesh="m"/>'), "uses refpos"),
    "mjcf includes itself": ("a.xml", MJCF.format('<include file="a.xml"/>', BALL), "includes itself"),
    "mjcf includes outside": ("a.xml", MJCF.format('<include file="../../b.xml"/>', BALL), "not inside"),
    "mjcf includes itself twice": ("a.xml", MJCF.format(2 * '<include file="a.xml"/>', BALL), "100 files"),
    "mjcf includes nothing": ("a.xml", MJCF.format('<include file="b.xml"/>', BALL), "b.xml"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_skipped_with_its_reason(case: str, tmp_path: Path) -> None:
    name, content, named = BAD[case]
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / name).write_bytes(content.encode() if isinstance(content, str) else content)
    (tmp_path.parent / "b.xml").write_text(MJCF.format("", BALL))
    (tmp_path / "bad/a.msh").write_bytes(struct.pack("<4i", 8, 0, 0, 10**9) + bytes(96))
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "good")
    source = open_objects(f"folder:{tmp_path}")
    assert source.names() == ["good"]
    reason = source.excluded["a"]
    assert named in reason and "\n" not in reason and len(reason) < 600, reason
    assert "outside" in case or "above" in case or "bad/" in reason
    assert str(tmp_path) not in reason


@pytest.mark.parametrize("content", [None, b"", b"v 0 0 0\n"])
def test_a_folder_without_any_usable_object_is_refused(content: bytes | None, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    if content is not None:
        (folder / "a.obj").write_bytes(content)
    with pytest.raises(InputError, match="has no usable object") as caught:
        open_objects(f"folder:{folder}")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError):
        open_objects(f"folder:{folder / 'a.obj'}")


def test_links_out_of_the_folder_are_not_followed(tmp_path: Path) -> None:
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "outside")
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "set/good")
    (tmp_path / "set/file.stl").symlink_to(tmp_path / "outside/outside.stl")
    (tmp_path / "set/folder").symlink_to(tmp_path / "outside")
    (tmp_path / "set/loop.stl").symlink_to("loop.stl")
    source = open_objects(f"folder:{tmp_path / 'set'}")
    assert source.names() == ["good"]
    assert "not inside" in source.excluded["file"] and set(source.excluded) == {"file", "loop"}


def test_a_texture_outside_or_broken_leaves_a_plain_colour(tmp_path: Path) -> None:
    for name, image in (("outside", "../../secret.png"), ("broken", "broken.png")):
        write_as("obj", box(0.04, 0.05, 0.06), tmp_path / "set" / name)
        file = tmp_path / "set" / name / f"{name}.obj"
        (file.parent / "a.mtl").write_text(f"newmtl a\nKd 1 0 0\nmap_Kd {image}\n")
        (file.parent / "broken.png").write_bytes(b"\x89PNG")
        file.write_text(f"mtllib a.mtl\nusemtl a\nvt 0 0\n{file.read_text()}".replace("f ", "f "))
        text = file.read_text().splitlines()
        faces = [
            f"f {' '.join(f'{c}/1' for c in line.split()[1:])}" for line in text if line.startswith("f ")
        ]
        file.write_text("\n".join([*(line for line in text if not line.startswith("f ")), *faces]))
    (tmp_path / "secret.png").write_bytes(b"\x89PNG")
    source = FolderObjects(tmp_path / "set")
    for name in source.names():
        assert "texture missing" in source.notes[name]
        np.testing.assert_array_equal(source.load(name).visual.face_rgb, np.tile([255, 0, 0], (12, 1)))


def _no_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decomposition, "_PROGRAM", "import sys; sys.exit(\"No module named 'coacd'\")")


def _crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decomposition, "_PROGRAM", "import os; os.abort()")


def _nonsense(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decomposition, "_PROGRAM", "print('PARTS')")


def _hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decomposition, "_PROGRAM", "import time; time.sleep(60)")
    monkeypatch.setattr(decomposition, "_LONGEST_S", 0.5)


@pytest.mark.parametrize(
    ("fault", "named"),
    [(_no_library, "needs coacd"), (_crash, "(-6)"), (_nonsense, "cannot be decomposed"), (_hang, "after 0")],
)
def test_a_decomposition_that_fails_costs_its_object(
    fault: Callable[[pytest.MonkeyPatch], None], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_as("stl", cup(), tmp_path / "cup")
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "box")
    fault(monkeypatch)
    source = open_objects(f"folder:{tmp_path}")
    assert source.names() == ["box"] and named in source.excluded["cup"]


def test_a_decomposition_ends_with_the_program_that_a_signal_ends(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5)
    ball.vertices *= 0.04 + 0.01 * np.sin(9 * ball.vertices).prod(axis=1, keepdims=True)  # for some seconds
    write_as("stl", ball, tmp_path / "ball")
    environment = {**os.environ, "DATAGEN_CACHE": str(tmp_path / "cache")}
    words = [sys.executable, "-m", "datagen.cli", "assets", "check", str(tmp_path / "ball")]
    with subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL) as process:
        child = _decomposing(psutil.Process(process.pid))
        process.terminate()
    assert process.returncode == -signal.SIGTERM
    child.wait(5)


def _decomposing(parent: psutil.Process) -> psutil.Process:
    """The child that has loaded CoACD."""
    until = time.monotonic() + 60
    while time.monotonic() < until:
        for child in parent.children():
            with suppress(psutil.Error):
                if any("coacd" in file.path for file in child.memory_maps()):
                    return child
        time.sleep(0.02)
    raise AssertionError("nothing was decomposed")


@pytest.mark.slow
def test_a_mesh_of_a_million_faces_is_refused(tmp_path: Path) -> None:
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "box")
    rows = np.zeros((1_000_000, 50), np.uint8)
    rows[:, :48] = np.random.default_rng(0).random((len(rows), 12), np.float32).view(np.uint8)
    (tmp_path / "box/a million.stl").write_bytes(bytes(80) + struct.pack("<I", len(rows)) + rows.tobytes())
    source = open_objects(f"folder:{tmp_path}")
    assert source.names() == ["box"]
    assert f"more than {surfaces.MAX_FACES}" in source.excluded["a million"]
