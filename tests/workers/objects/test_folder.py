"""Objects of any folder: the same object in each format, units, axes, masses, names and layouts."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.workers.objects import open_objects
from datagen.workers.objects.convex import opening_depth
from datagen.workers.objects.folder import FolderObjects
from tests.workers.objects.folder_files import box, cup, write_as, write_gso
from tests.workers.objects.toy_set import CUBE_OBJ, texture_png, write_bundle, write_maniskill

KINDS = ("obj", "ply", "stl", "mm.stl", "glb", "gltf", "y.obj", "urdf", "sdf", "mjcf", "msh")
STATED = ("urdf", "sdf", "mjcf", "msh")


@settings(max_examples=3, deadline=None)
@given(sides_mm=st.tuples(*[st.integers(25, 200)] * 3))
def test_a_box_is_the_same_in_each_format(
    sides_mm: tuple[int, int, int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder, sides_m = tmp_path_factory.mktemp("boxes"), np.array(sides_mm) / 1000
    # Upright, as y is only tried where z is no side that it stands on.
    sides_m[2] = min(sides_m[2], 4 * sides_m[:2].min())
    for kind in KINDS:
        write_as(kind, box(*sides_m), folder / kind.replace(".", "-"), mass_kg=900 * float(sides_m.prod()))
    source = open_objects(f"folder:{folder}")
    assert len(source.names()) == len(KINDS) and not source.excluded
    for name in source.names():
        model = source.load(name)
        np.testing.assert_allclose(model.size_m, sides_m, atol=2e-6, err_msg=name)
        density = 900 if name in STATED else 500
        assert model.mass_kg == pytest.approx(density * sides_m.prod(), rel=1e-3), name
        assert len(model.convex_parts_m) == 1
        np.testing.assert_allclose(np.abs(model.convex_parts_m[0]), np.tile(sides_m / 2, (8, 1)), atol=2e-6)
        assert trimesh.Trimesh(model.visual.vertices_m, model.visual.faces, process=False).volume > 0, name


@pytest.mark.slow
def test_a_cup_without_collision_mesh_keeps_its_opening_in_each_format(
    tmp_path: Path, own_cache: Path
) -> None:
    for kind in KINDS:
        write_as(kind, cup(), tmp_path / "set" / kind.replace(".", "-"))
    source = FolderObjects(tmp_path / "set")
    models = [source.load(name) for name in source.names()]
    assert len(models) == len(KINDS)
    for model in models:
        np.testing.assert_allclose(model.size_m, models[0].size_m, atol=2e-6, err_msg=model.name)
        assert len(model.convex_parts_m) == len(models[0].convex_parts_m) > 4
        assert opening_depth(model.visual.vertices_m, model.convex_parts_m) > 0.07
        assert model.can_be_target
        assert "95% of the surface within" in source.notes[model.name]["decomposed"]
    masses = {model.name: model.mass_kg for model in models}
    assert all(masses[name] == 0.2 for name in STATED)
    by_density = [mass for name, mass in masses.items() if name not in STATED]
    np.testing.assert_allclose(by_density, by_density[0], rtol=1e-4)
    # What the cache keeps is what is computed again without it.
    again = FolderObjects(tmp_path / "set")
    assert again.digest == source.digest
    shutil.rmtree(own_cache)
    assert FolderObjects(tmp_path / "set").digest == source.digest
    lost = FolderObjects(tmp_path / "set")
    shutil.rmtree(own_cache / "objects")
    assert (
        lost.load("obj").convex_parts_m[3].tobytes()
        == models[source.names().index("obj")].convex_parts_m[3].tobytes()
    )


def test_the_digest_is_of_the_content_and_not_of_the_path(tmp_path: Path) -> None:
    write_as("obj", box(0.04, 0.05, 0.06), tmp_path / "a/box")
    write_as("obj", box(0.04, 0.05, 0.06), tmp_path / "b/deeper/box")
    write_as("obj", box(0.04, 0.05, 0.061), tmp_path / "c/box")
    first, same, other = (open_objects(f"folder:{tmp_path / name}").digest for name in "abc")
    assert same == first != other


def test_names_may_have_spaces_and_any_letters(tmp_path: Path) -> None:
    for name in ("blue cup", "Tässchen ☕", "茶碗"):
        write_as("stl", box(0.04, 0.05, 0.06), tmp_path / name)
    (tmp_path / "a\nb").mkdir()
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "a\nb")
    source = open_objects(f"folder:{tmp_path}")
    assert source.names() == ["Tässchen ☕", "blue cup", "茶碗"]
    assert "unprintable" in source.excluded["a\nb"]


def test_published_trees_and_roles_of_files_give_one_object_each(tmp_path: Path) -> None:
    for scan in ("google_16k", "poisson", "clouds"):
        home = tmp_path / "011_banana" / scan
        home.mkdir(parents=True)
        box(0.19, 0.05, 0.04 if scan == "google_16k" else 0.06).export(home / "nontextured.ply")
        box(0.19, 0.05, 0.04 if scan == "google_16k" else 0.06).export(home / "textured.obj")
    home = tmp_path / "tray"
    home.mkdir()
    box(0.2, 0.1, 0.02).export(home / "tray.obj")
    box(0.2, 0.1, 0.02).export(home / "tray_collision.stl")
    for shelf in ("left", "right"):
        write_as("obj", box(0.1, 0.1, 0.1), tmp_path / shelf / "cube")
    source = open_objects(f"folder:{tmp_path}")
    assert source.names() == ["011_banana", "left/cube/cube", "right/cube/cube", "tray"]
    banana = source.load("011_banana")
    assert banana.size_m[2] == pytest.approx(0.04) and banana.mass_kg == 0.066


def test_older_versions_and_markers_of_an_object_are_no_objects(tmp_path: Path) -> None:
    write_as("sdf", box(0.05, 0.05, 0.1), tmp_path / "coke_can")
    write_as("urdf", box(0.05, 0.05, 0.1), tmp_path / "tea-visual")
    write_as("mjcf", box(0.05, 0.05, 0.1), tmp_path / "bread")
    for name, twin in (("coke_can/model.sdf", "model-1_4.sdf"), ("bread/bread.xml", "bread-visual.xml")):
        (tmp_path / name).with_name(twin).write_bytes((tmp_path / name).read_bytes())
    assert sorted(open_objects(f"folder:{tmp_path}").names()) == ["bread", "coke_can", "tea-visual"]


@pytest.mark.parametrize("write", [write_bundle, write_maniskill])
def test_an_indexed_folder_is_read_as_ycb_reads_it(write: object, tmp_path: Path) -> None:
    folder = write(tmp_path / "set")  # type: ignore[operator]
    source, indexed = open_objects(f"folder:{folder}"), open_objects(f"ycb:{folder}")
    assert (source.kind, source.digest) == ("ycb", indexed.digest)


def test_the_table_states_mass_density_scale_and_axis(tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d"):
        write_as("stl", box(0.04, 0.05, 0.06), tmp_path / name)
    (tmp_path / "objects.csv").write_text(
        "name, mass_kg, density_kg_m3, scale, up\n*,,800,,\na, 0.3,,,\nb,,,2,x\nc,,100,,\n"
    )
    source = open_objects(f"folder:{tmp_path}")
    assert source.load("a").mass_kg == 0.3
    np.testing.assert_allclose(source.load("b").size_m, (0.12, 0.10, 0.08), atol=1e-6)
    assert source.load("c").mass_kg == pytest.approx(100 * 0.04 * 0.05 * 0.06, rel=1e-5)
    assert source.load("d").mass_kg == pytest.approx(800 * 0.04 * 0.05 * 0.06, rel=1e-5)


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ("e,1,,,", "'e' is no object"),
        ("a,heavy,,,", "mass_kg = 'heavy'"),
        ("a,nan,,,", "mass_kg = 'nan'"),
        ("a,,,,w", "up = 'w'"),
        ("a,,,,,,", "cannot be read"),
        ("a,1,,,\na,2,,,", "line 3"),
    ],
)
def test_a_bad_row_is_named(row: str, named: str, tmp_path: Path) -> None:
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "a")
    (tmp_path / "objects.csv").write_text(f"name,mass_kg,density_kg_m3,scale,up\n{row}\n")
    with pytest.raises(InputError, match=r"objects\.csv: line") as caught:
        open_objects(f"folder:{tmp_path}")
    assert named in str(caught.value)


def test_what_is_assumed_is_noted(tmp_path: Path) -> None:
    mesh = box(0.04, 0.05, 0.06)
    write_as("mm.stl", mesh, tmp_path / "mm")
    write_as("y.obj", box(0.02, 0.03, 0.3), tmp_path / "tall")
    write_as("urdf", mesh, tmp_path / "heavy", mass_kg=100.0)
    write_as("ply", mesh.copy().apply_translation((3, 0, 0)), tmp_path / "far")
    lid = box(0.04, 0.05, 0.002)  # thin: to decompose an open box takes six times as long
    lid.update_faces(np.arange(len(lid.faces)) > 0)
    write_as("ply", lid, tmp_path / "open")
    write_as("stl", box(0.7, 0.5, 0.02), tmp_path / "large")
    oak = "newmtl oak\nKd 1 0 0\n"
    write_as("obj", box(0.04, 0.05, 0.06), tmp_path / "oak")
    (tmp_path / "oak/oak.mtl").write_text(oak)
    text = (tmp_path / "oak/oak.obj").read_text()
    (tmp_path / "oak/oak.obj").write_text(f"mtllib oak.mtl\nusemtl oak\n{text}")
    notes = FolderObjects(tmp_path).notes
    assert notes["mm"]["in millimetres"] == "it spans 60"
    assert "mass not plausible" in notes["heavy"] and notes["heavy"]["mass by density"] == "500 kg/m3 assumed"
    assert notes["far"]["far from its origin"] == "3.00 m"
    assert "not watertight" in notes["open"] and "not watertight" not in notes["mm"]
    assert notes["large"]["large"] == "0.70 m"
    assert notes["oak"]["mass by density"] == "600 kg/m3 of oak"


def test_textures_lie_on_the_faces_that_have_them(tmp_path: Path) -> None:
    """One image; an image and a colour (an atlas); the Google Scanned Objects' place of an image."""
    for name, library in (
        ("one", "newmtl a\nmap_Kd t.png\n"),
        ("two", "newmtl a\nmap_Kd t.png\nnewmtl b\nKd 0 1 0\n"),
    ):
        (tmp_path / name).mkdir()
        lines = CUBE_OBJ.replace("textured.mtl", "c.mtl").replace("material_0", "a")
        if name == "two":
            lines = lines.replace("f 1/1 2/2 6/3 5/4", "usemtl b\nf 1/1 2/2 6/3 5/4")
        (tmp_path / name / f"{name}.obj").write_text(lines)
        (tmp_path / name / "c.mtl").write_text(library)
        (tmp_path / name / "t.png").write_bytes(texture_png())
    write_gso(tmp_path / "scanned", box(0.04, 0.05, 0.06))
    source = FolderObjects(tmp_path)
    for name in ("one", "two"):
        mesh = source.load(name).visual
        a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        top, bottom = normals[:, 2] > 1e-9, normals[:, 2] < -1e-9
        np.testing.assert_array_equal(mesh.face_rgb[top], [[0, 0, 255]] * 2, err_msg=name)
        np.testing.assert_array_equal(mesh.face_rgb[bottom], [[255, 0, 0]] * 2, err_msg=name)
        sides = mesh.face_rgb[~top & ~bottom]
        assert {tuple(rgb) for rgb in sides.tolist()} == {"one": {(255, 0, 0)}, "two": {(0, 248, 0)}}[name]
    scanned = source.load("scanned").visual
    assert scanned.texture is not None
    np.testing.assert_array_equal(scanned.face_rgb, np.tile([0, 0, 255], (12, 1)))
    assert not source.notes["scanned"].get("texture missing")


def test_colours_of_vertices_gltf_images_and_mujoco_materials_are_kept(tmp_path: Path) -> None:
    mesh = box(0.04, 0.05, 0.06)
    mesh.visual.vertex_colors = [10, 200, 30, 255]
    (tmp_path / "points").mkdir()
    mesh.export(tmp_path / "points/points.ply")
    mesh = box(0.04, 0.05, 0.06)
    image = Image.new("RGB", (4, 4), (200, 10, 10))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.full((8, 2), 0.5), material=material)
    (tmp_path / "glb").mkdir()
    mesh.export(tmp_path / "glb/glb.glb")
    (tmp_path / "gltf").mkdir()
    for file, data in mesh.export(file_type="gltf").items():
        (tmp_path / "gltf" / file).write_bytes(data)
    document = json.loads((tmp_path / "gltf/model.gltf").read_text())
    (tmp_path / "gltf/model.gltf").write_text(json.dumps({**document, "images": [{"uri": "an%20image.png"}]}))
    image.save(tmp_path / "gltf/an image.png")
    write_as("mjcf", box(0.04, 0.05, 0.06), tmp_path / "red")
    source = open_objects(f"folder:{tmp_path}")
    reds = ("glb", (200, 10, 10)), ("gltf", (200, 10, 10)), ("red", (255, 0, 0))
    for name, rgb in (("points", (10, 200, 30)), *reds):
        np.testing.assert_array_equal(source.load(name).visual.face_rgb, np.tile(rgb, (12, 1)), err_msg=name)


def test_a_statement_is_kept(tmp_path: Path) -> None:
    write_as("stl", box(0.04, 0.05, 0.06), tmp_path / "a")
    (tmp_path / "source.json").write_text(json.dumps({"licence": "CC0-1.0"}))
    assert FolderObjects(tmp_path).statement == {"licence": "CC0-1.0"}


def test_what_does_not_stand_is_laid_on_its_most_probable_side(tmp_path: Path) -> None:
    write_as("stl", box(0.2, 0.003, 0.2), tmp_path / "plate on edge")
    write_as("stl", box(0.004, 0.15, 0.004).apply_translation((0, 0.2, 1)), tmp_path / "lying pen")
    pan = trimesh.util.concatenate(
        [box(0.2, 0.2, 0.04), box(0.3, 0.02, 0.01).apply_translation((0.3, 0, 0.03))]
    )
    # Tilted, it stands neither on z nor on y; its bottom is nearer to z than its rim.
    tilted = trimesh.transformations.rotation_matrix(0.3, (0.8, 0.6, 0))
    write_as("stl", pan.apply_transform(tilted), tmp_path / "tilted pan")
    write_as("stl", trimesh.creation.icosphere(radius=0.03), tmp_path / "ball")
    source = FolderObjects(tmp_path)
    assert source.load("plate on edge").size_m[2] == pytest.approx(0.003, abs=1e-5)
    assert source.load("lying pen").size_m[2] == pytest.approx(0.004, abs=1e-5)
    assert source.load("tilted pan").size_m[2] == pytest.approx(0.04, abs=1e-3)
    assert source.load("tilted pan").visual.vertices_m[:, 2].mean() > 0, "the handle is above"
    notes = {name: set(source.notes[name]) & {"laid on its side", "y was up"} for name in source.names()}
    assert notes == {
        "ball": set(),
        "lying pen": set(),
        "plate on edge": {"y was up"},
        "tilted pan": {"laid on its side"},
    }


@pytest.mark.parametrize("others", [(), ("cup",)])
def test_numbered_collision_meshes_are_the_parts_of_one_object(
    tmp_path: Path, others: tuple[str, ...]
) -> None:
    write_as("obj", box(0.2, 0.06, 0.1), tmp_path / "board")
    home = tmp_path / "board"
    for k, x in enumerate((-0.05, 0.05)):
        half = box(0.1, 0.06, 0.1)
        half.apply_translation((x, 0, 0)).export(home / f"board_collision_{k}.obj")
    box(0.2, 0.06, 0.1).export(home / "board_vhacd.obj")  # another decomposition, which is not added
    for name in others:
        box(0.05, 0.05, 0.05).export(home / f"{name}.stl")
    source = FolderObjects(tmp_path)
    assert source.names() == ["board", *others]
    parts = source.load("board").convex_parts_m
    assert sorted(float(part[:, 0].mean()) for part in parts) == pytest.approx([-0.05, 0.05])
    assert set(source.notes["board"]) == {"mass by density"}
