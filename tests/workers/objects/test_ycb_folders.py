"""Both layouts of YCB folders, the cache, and folders with something wrong in them."""

from __future__ import annotations

import io
import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.workers.objects import convex, open_objects, texture
from tests.workers.objects.toy_set import COLLISION_OBJ, CUBE_OBJ, write_bundle, write_maniskill


def test_bundle_layout(tmp_path: Path) -> None:
    source = open_objects(f"ycb:{write_bundle(tmp_path / 'set', '002_b', '001_a')}")
    assert source.names() == ["001_a", "002_b"]
    model = source.load("001_a")
    np.testing.assert_allclose(model.size_m, 0.04, atol=1e-9)
    np.testing.assert_allclose(model.visual.vertices_m.min(axis=0), -0.02, atol=1e-7)
    assert len(model.convex_parts_m) == 1
    np.testing.assert_allclose(np.abs(model.convex_parts_m[0]), 0.02, atol=1e-7)
    assert model.radius_m == pytest.approx(0.02 * 3**0.5, abs=1e-7)
    assert model.mass_kg == 0.05 and model.can_be_target


def test_seams_are_split_and_colours_sit_where_the_texture_says(tmp_path: Path) -> None:
    model = open_objects(f"ycb:{write_bundle(tmp_path / 'set')}").load("001_cube")
    mesh = model.visual
    assert mesh.texture is not None
    assert len(mesh.vertices_m) > 8, "corners with several texture coordinates must be split"
    assert len(mesh.faces) == 12
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    top = normals[:, 2] > 1e-9
    # The top carries the right half of the image (u from 0.5 to 1), which is blue; the rest is red.
    np.testing.assert_array_equal(mesh.face_rgb[top], [[0, 0, 255]] * 2)
    np.testing.assert_array_equal(mesh.face_rgb[~top], [[255, 0, 0]] * 10)


@pytest.mark.parametrize("ply", [True, False])
def test_maniskill_layout(tmp_path: Path, ply: bool) -> None:
    folder = write_maniskill(tmp_path / "set", "011_banana", "099_toy", "063-b_marbles", density=500, ply=ply)
    source = open_objects(f"ycb:{folder}")
    # Masses that come from a density are not those that made the table leave the marble out.
    assert source.names() == ["011_banana", "063-b_marbles", "099_toy"]
    assert source.load("011_banana").mass_kg == 0.066
    toy = source.load("099_toy")
    assert toy.mass_kg == pytest.approx(500 * 0.04**3, rel=1e-6)
    np.testing.assert_allclose(toy.size_m, 0.04, atol=1e-9)
    assert len(toy.convex_parts_m) == (2 if ply else 1)


def test_digests_follow_the_content_not_the_path(tmp_path: Path) -> None:
    first = open_objects(f"ycb:{write_bundle(tmp_path / 'one')}")
    same = open_objects(f"ycb:{write_bundle(tmp_path / 'two')}")
    heavier = open_objects(f"ycb:{write_bundle(tmp_path / 'three', mass_kg=0.051)}")
    changed = write_bundle(tmp_path / "four")
    (changed / "001_cube/textured.obj").write_text(CUBE_OBJ + "# changed\n")
    assert first.digest == same.digest
    assert len({first.digest, heavier.digest, open_objects(f"ycb:{changed}").digest}) == 3


def test_a_damaged_cache_is_rebuilt_without_a_change(
    tmp_path: Path, own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_bundle(tmp_path / "set")
    fresh = open_objects(f"ycb:{folder}").load("001_cube")
    (entry,) = (own_cache / "objects").iterdir()
    with monkeypatch.context() as patch:
        patch.setattr("datagen.workers.objects.scan.read_scan", lambda *_: pytest.fail("read again"))
        again = open_objects(f"ycb:{folder}").load("001_cube")
    entry.write_bytes(entry.read_bytes()[:500])
    healed = open_objects(f"ycb:{folder}").load("001_cube")
    for other in (again, healed):
        assert other.visual.vertices_m.tobytes() == fresh.visual.vertices_m.tobytes()
        assert other.visual.face_rgb.tobytes() == fresh.visual.face_rgb.tobytes()
        assert other.digest == fresh.digest and other.size_m == fresh.size_m
        assert [p.tobytes() for p in other.convex_parts_m] == [p.tobytes() for p in fresh.convex_parts_m]
    assert [p.name for p in (own_cache / "objects").iterdir()] == [entry.name]


def test_flat_parts_are_dropped(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    box = np.concatenate([square, square + [0, 0, 1]])
    parts = convex.convex_parts([square, box, box[:3], box * [1, 1, 1e-6], box * 0.01])
    assert len(parts.vertices_m) == 2
    assert parts.volume_m3 == pytest.approx(1 + 1e-6)


def test_incredible_densities_are_left_out_with_the_reason(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "set", "001_good", "002_bad")
    _index(folder, lambda index: index[1].update(mass_kg=40.0))
    source = open_objects(f"ycb:{folder}")
    assert source.names() == ["001_good"]
    assert "kg/m3" in source.excluded["002_bad"]


def _index(folder: Path, change: Callable[[list[dict[str, Any]]], object]) -> None:
    path = folder / "objects.json"
    index = json.loads(path.read_text())
    change(index)
    path.write_text(json.dumps(index))


def _set(key: str, value: object) -> Callable[[Path], None]:
    return lambda folder: _index(folder, lambda index: index[0].update({key: value}))


def _file(kind: str, value: object) -> Callable[[Path], None]:
    return lambda folder: _index(folder, lambda index: index[0]["files"].update({kind: value}))


def _write(name: str, content: str | bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return change


def _huge_png() -> bytes:
    """A valid header of an image with 10 giga-pixels."""
    head = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head)) + bytes(100)
    )


def _scaled(factor: float) -> str:
    lines = [line.split() for line in CUBE_OBJ.splitlines()]
    return "\n".join(
        " ".join(["v", *[str(float(x) * factor) for x in line[1:]]]) if line[0] == "v" else " ".join(line)
        for line in lines
    )


MESH, IMAGE, PARTS = "001_cube/textured.obj", "001_cube/texture.png", "001_cube/collision.obj"
BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "no index": (lambda f: (f / "objects.json").unlink(), "none of objects.json"),
    "index is a folder": (lambda f: ((f / "objects.json").unlink(), (f / "objects.json").mkdir()), "none of"),
    "index is not JSON": (_write("objects.json", "{"), "not JSON"),
    "index is an object": (_write("objects.json", "{}"), "objects.json"),
    "index is empty": (_write("objects.json", "[]"), "at least 1"),
    "no mass": (lambda f: _index(f, lambda index: index[0].pop("mass_kg")), "[0].mass_kg"),
    "mass 0": (_set("mass_kg", 0), "[0].mass_kg"),
    "mass NaN": (_set("mass_kg", float("nan")), "[0].mass_kg"),
    "mass of a piano": (_set("mass_kg", 300), "[0].mass_kg"),
    "key with a path": (_set("key", "../x"), "[0].key"),
    "key twice": (lambda f: _index(f, lambda index: index.append(index[0])), "[1].key"),
    "path escapes": (_file("visual", "../../etc/passwd"), "[0].files.visual"),
    "path absolute": (_file("texture", "/etc/passwd"), "[0].files.texture"),
    "path empty": (_file("collision", ""), "[0].files.collision"),
    "path with NUL": (_file("collision", "a\0b"), "[0].files.collision"),
    "path through a link": (
        lambda f: ((f / "001_cube").rename(f / "x"), (f / "001_cube").symlink_to("/usr")), "[0].files.visual"
    ),
    "mesh missing": (lambda f: (f / MESH).unlink(), "textured.obj"),
    "mesh without faces": (_write(MESH, "v 0 0 0\n"), "no faces"),
    "mesh without texture coordinates": (_write(MESH, COLLISION_OBJ), "texture coordinates"),
    "mesh in millimetres": (_write(MESH, _scaled(1000)), "metres"),
    "mesh with NaN": (_write(MESH, CUBE_OBJ.replace("0.05 0.02 0.00", "nan 0 0")), "line 4"),
    "mesh with a missing corner": (_write(MESH, CUBE_OBJ + "f 1/1 2/2 9/3\n"), "refers to"),
    "texture not an image": (_write(IMAGE, b"hello"), "not a readable"),
    "texture cut off": (lambda f: (f / IMAGE).write_bytes((f / IMAGE).read_bytes()[:50]), "not a readable"),
    "texture bomb": (_write(IMAGE, _huge_png()), "texture.png"),
    "parts flat": (_write(PARTS, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "flat"),
    "parts elsewhere": (_write(PARTS, COLLISION_OBJ.replace("v 0.0", "v 0.9")), "bounding box"),
    "all left out": (_set("mass_kg", 49), "has no usable object"),
}  # fmt: skip


PLY, MTL = "models/001_cube/collision.ply", "models/001_cube/textured.mtl"
HUGE_PLY = "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n"
STAR = json.dumps({"001_cube": {"density": 1e18}})
BAD_MANISKILL: dict[str, tuple[Callable[[Path], object], str]] = {
    "density of a star": (_write("info_pick_v0.json", STAR), "001_cube.density"),
    "no parts": (lambda f: (f / PLY).unlink(), "collision.ply"),
    "parts broken": (_write(PLY, "ply\nformat ascii 1.0\nelement"), "collision.ply"),
    "parts claim too much": (_write(PLY, HUGE_PLY), "collision.ply"),
    "no library": (lambda f: (f / MTL).unlink(), "textured.mtl"),
    "no image": (_write(MTL, "newmtl material_0\n"), "no texture image"),
    "no material": (_write(MTL, ""), "0 texture images"),
    "image outside": (_write(MTL, "newmtl material_0\nmap_Kd ../../../x.png\n"), "map_Kd"),
    "model missing": (lambda f: shutil.rmtree(f / "models/001_cube"), "textured.obj"),
}
CASES = [(write_bundle, BAD, case) for case in BAD] + [
    (write_maniskill, BAD_MANISKILL, case) for case in BAD_MANISKILL
]


@pytest.mark.parametrize(("write", "table", "case"), CASES, ids=[case for _, _, case in CASES])
def test_bad_folders_are_refused_in_one_line(
    write: Callable[[Path], Path], table: dict[str, Any], case: str, tmp_path: Path
) -> None:
    folder = write(tmp_path / "set")
    change, named = table[case]
    change(folder)
    with pytest.raises(InputError) as caught:
        open_objects(f"ycb:{folder}")
    message = str(caught.value)
    assert named in message and str(folder) in message and "\n" not in message


def test_large_textures_are_reduced(tmp_path: Path) -> None:
    out = io.BytesIO()
    Image.new("RGB", (2000, 1000), (10, 20, 30)).save(out, "JPEG", quality=95)
    (tmp_path / "t.jpg").write_bytes(out.getvalue())
    image = texture.read_texture(tmp_path / "t.jpg")
    assert image.shape == (256, 512, 3)
    np.testing.assert_allclose(image.reshape(-1, 3).mean(axis=0), [10, 20, 30], atol=3)
