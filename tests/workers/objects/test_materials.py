"""Materials, textures, axes and collision parts that do not stand for the mesh."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.workers.objects import open_objects
from datagen.workers.objects.convex import read_convex_parts
from datagen.workers.objects.obj_file import read_obj
from datagen.workers.objects.texture import read_texture, texture_of_materials
from tests.workers.objects.toy_set import COLLISION_OBJ, CUBE_OBJ, write_bundle, write_maniskill

TWO_MATERIALS = CUBE_OBJ.replace("f 2/1", "usemtl other\nf 2/1")
LIBRARY = "newmtl material_0\nKd 1 1 1\nmap_Kd texture.png\nnewmtl other\n"


@pytest.mark.parametrize("layout", ["bundle", "maniskill"])
@pytest.mark.parametrize(
    ("other", "named"),
    [
        ("Kd 1 0 0\n", "newmtl other: has a colour and no texture image"),
        ("map_Kd other.png\n", "2 texture images"),
        ("map_Kd texture.png\n", ""),
    ],
)
def test_one_texture_stands_for_all_materials_or_none(
    layout: str, other: str, named: str, tmp_path: Path
) -> None:
    folder = (write_bundle if layout == "bundle" else write_maniskill)(tmp_path / "set")
    home = folder / "001_cube" if layout == "bundle" else folder / "models/001_cube"
    (home / "textured.obj").write_text(TWO_MATERIALS)
    (home / "textured.mtl").write_text(LIBRARY + other)
    if named:
        with pytest.raises(InputError, match=named):
            open_objects(f"ycb:{folder}")
    else:
        assert open_objects(f"ycb:{folder}").names() == ["001_cube"]


@pytest.mark.parametrize("library", ["", "../textured.mtl", "/etc/passwd"])
def test_several_materials_need_a_library_of_the_folder(library: str, tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "set")
    text = TWO_MATERIALS.replace("mtllib textured.mtl", f"mtllib {library}" if library else "#")
    (folder / "001_cube/textured.obj").write_text(text)
    with pytest.raises(InputError, match=r"textured\.obj: mtllib: 2 materials"):
        open_objects(f"ycb:{folder}")


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ('map_Kd -s 1 1 1 "a b.png" # x', "a b.png"),
        ("map_Kd -s 1 1 1 a b.png", "a b.png"),
        ("map_Kd\t-clamp on -o 0 0 -mm 0 1 -bm 0.5 dir/a.png   # the best", "dir/a.png"),
        ("map_Kd a#b.png", "a#b.png"),
        ("  map_Kd   it's.png  ", "it's.png"),
    ],
)
def test_names_of_textures_follow_options_and_quotes(line: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text(f"newmtl m\n{line}\n")
    assert texture_of_materials(tmp_path / "a.mtl", ("m",)) == name


@pytest.mark.parametrize("line", ["-s 2 2 1 a.png", "-o 0.5 a.png", "-t 0 0.1 0 a.png", "-what 1 a.png"])
def test_options_that_move_the_texture_are_refused(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text(f"newmtl m\nmap_Kd {line}\n")
    with pytest.raises(InputError, match=r"a\.mtl: line 2: "):
        texture_of_materials(tmp_path / "a.mtl", ("m",))


@pytest.mark.parametrize(("value", "expected"), [(40000, 156), (0, 0), (65535, 255), (255, 0)])
def test_grey_of_16_bits_keeps_its_brightness(value: int, expected: int, tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 4), value, np.uint16)).save(tmp_path / "grey.png")
    assert (read_texture(tmp_path / "grey.png") == expected).all()


def mug() -> trimesh.Trimesh:
    """A cup with a 3 mm wall, its base on z = 0."""
    return trimesh.creation.annulus(r_min=0.037, r_max=0.04, height=0.09, transform=_lifted(0.045))


def _lifted(z: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = z
    return T


def banana() -> trimesh.Trimesh:
    """A bent bar."""
    bar = trimesh.creation.cylinder(0.015, 0.2, sections=24).subdivide().subdivide().subdivide()
    bar.vertices[:, 0] += 5 * bar.vertices[:, 2] ** 2
    return bar


@pytest.mark.parametrize("shape", [mug, banana])
@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_a_visual_mesh_does_not_serve_as_collision_parts(
    suffix: str, shape: Callable[[], trimesh.Trimesh], tmp_path: Path
) -> None:
    path = tmp_path / f"collision.{suffix}"
    shape().export(path)
    with pytest.raises(InputError, match=r"part 1: not convex: (a vertex lies \d+ mm|its surface encloses)"):
        read_convex_parts(path)
    trimesh.creation.cylinder(0.04, 0.09).export(path)
    assert len(read_convex_parts(path).vertices_m) == 1


def _turned(text: str) -> str:
    """The same mesh with y up: (x, y, z) -> (x, z, -y)."""
    lines = [line.split() for line in text.splitlines()]
    return "\n".join(f"v {x[1]} {x[3]} {-float(x[2])}" if x[:1] == ["v"] else " ".join(x) for x in lines)


def test_a_mesh_that_stands_on_y_is_refused(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path / "set")
    assert open_objects(f"ycb:{folder}").names() == ["001_cube"]
    (folder / "001_cube/textured.obj").write_text(_turned(CUBE_OBJ))
    (folder / "001_cube/collision.obj").write_text(_turned(COLLISION_OBJ))
    with pytest.raises(InputError, match=r"textured\.obj: v: y is up: .* z = -0\.060 m.*z up"):
        open_objects(f"ycb:{folder}")


def test_no_real_object_has_any_of_these_faults(assets: Path) -> None:
    for path in sorted((assets / "ycb").glob("*/collision.obj"))[::6]:
        assert read_convex_parts(path).vertices_m
        assert len(read_obj(path.with_name("textured.obj")).materials) == 1


def test_a_texture_of_16_bits_keeps_its_brightness_in_scenes() -> None:
    from datagen.workers.objects.texture import rgb_of

    data = io.BytesIO()
    Image.fromarray(np.full((2, 2), 40000, np.uint16)).save(data, "PNG")
    assert np.asarray(rgb_of(Image.open(data)))[0, 0].tolist() == [156, 156, 156]
