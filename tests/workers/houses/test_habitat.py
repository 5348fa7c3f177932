"""Datasets of habitat in the layouts of HSSD and ReplicaCAD, with meshes made here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.workers.geometry.transforms import rotation_of
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House
from tests.workers.houses.house_checks import check_house, covers
from tests.workers.houses.test_ai2thor import box, export, floor

TABLE, BED, BOX = "a" * 40, "b" * 40, "c" * 40
HALF = float(np.sqrt(0.5))
Y_UP_TO_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
UP = {"up": [0, 1, 0], "front": [0, 0, -1]}


def table_top() -> trimesh.Trimesh:
    return box((1.4, 0.04, 0.8), (0, 0.72, 0), (160, 120, 80))


def table_legs() -> list[trimesh.Trimesh]:
    return [box((0.06, 0.7, 0.06), (x, 0.35, z), (90, 60, 40)) for x in (-0.65, 0.65) for z in (-0.35, 0.35)]


def stage() -> list[trimesh.Trimesh]:
    """A room of 6 x 5 m with walls and a ceiling."""
    return [
        floor(0, 6, 5, (150, 110, 70)),
        box((6, 2.5, 0.1), (3, 1.25, -0.05), (230, 230, 220)),
        box((6, 2.5, 0.1), (3, 1.25, 5.05), (230, 230, 220)),
        box((0.1, 2.5, 5), (-0.05, 1.25, 2.5), (230, 230, 220)),
        box((0.1, 2.5, 5), (6.05, 1.25, 2.5), (230, 230, 220)),
        box((6, 0.1, 5), (3, 2.6, 2.5), (255, 255, 255)),
    ]


def write(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def placed(
    name: str, at: tuple[float, float, float], turn: tuple[float, ...] = (1, 0, 0, 0), **more: Any
) -> dict:
    return {
        "template_name": name, "translation": list(at), "rotation": list(turn), "motion_type": "STATIC",
        "non_uniform_scale": [1.0, 1.0, 1.0], **more,
    }  # fmt: skip


def things(names: dict[str, str]) -> list[dict]:
    """A table turned by 90 degrees, a bed, a box on the floor, and something without a mesh."""
    return [
        placed(names["table"], (3.0, 0.0, 2.5), (HALF, 0, HALF, 0)),
        placed(names["bed"], (1.2, 0.0, 1.2)),
        placed(names["box"], (5.0, 0.0, 4.2)),
        placed("missing", (1.0, 0.0, 1.0)),
    ]


def write_hssd(root: Path) -> Path:
    """HSSD: hashes as names, configurations next to the meshes, convex parts as colliders, a lexicon."""
    names = {"table": TABLE, "bed": BED, "box": BOX}
    write(root / "hssd-hab.scene_dataset_config.json", {"scene_instances": {"paths": {".json": ["scenes"]}}})
    articulated = {"scene_instances": {"paths": {".json": ["scenes_articulated"]}}}
    write(root / "hssd-hab-articulated.scene_dataset_config.json", articulated)
    scene = {
        "stage_instance": {"template_name": "stages/102344022"},
        "translation_origin": "asset_local",
        "object_instances": things(names),
    }
    write(root / "scenes/102344022.scene_instance.json", scene)
    jointed = scene | {"articulated_object_instances": [{"template_name": "fridge"}]}
    write(root / "scenes_articulated/102344022.scene_instance.json", jointed)
    export(root / "stages/102344022.glb", stage())
    write(root / "stages/102344022.stage_config.json", {"render_asset": "102344022.glb", **UP})
    classes = [{"id": 3, "name": "table"}, {"id": 4, "name": "bed"}, {"id": 5, "name": "washer_dryer"}]
    write(root / "semantics/hssd-hab_semantic_lexicon.json", {"classes": classes})
    for name, semantic_id in ((TABLE, 3), (BED, 4), (BOX, 5)):
        config = {"render_asset": f"{name}.glb", "semantic_id": semantic_id, **UP}
        if name == TABLE:
            config["collision_asset"] = f"{name}.collider.glb"
        write(root / f"objects/{name[0]}/{name}.object_config.json", config)
    # What is seen of the table is one piece; its collider has five.
    export(root / f"objects/a/{TABLE}.glb", [trimesh.util.concatenate([table_top(), *table_legs()])])
    export(root / f"objects/a/{TABLE}.collider.glb", [table_top(), *table_legs()])
    export(root / f"objects/b/{BED}.glb", [box((1.4, 0.5, 2.0), (0, 0.25, 0), (90, 90, 140))])
    export(root / f"objects/c/{BOX}.glb", [box((0.7, 0.9, 0.7), (0, 0.45, 0), (230, 230, 230))])
    return root


def write_replicacad(root: Path) -> Path:
    """ReplicaCAD: names, configurations apart from the meshes, and a template without one."""
    dataset = {"scene_instances": {"paths": {".json": ["configs/scenes"]}}}
    write(root / "replicaCAD.scene_dataset_config.json", dataset)
    names = {k: f"objects/frl_apartment_{k}_01" for k in ("table", "bed", "box")}
    scene = {
        "stage_instance": {"template_name": "stages/frl_apartment_stage"},
        "object_instances": things(names),
        "articulated_object_instances": [{"template_name": "fridge"}, {"template_name": "door1"}],
    }
    write(root / "configs/scenes/apt_0.scene_instance.json", scene)
    config = {"render_asset": "../../stages/frl_apartment_stage.glb", **UP}
    write(root / "configs/stages/frl_apartment_stage.stage_config.json", config)
    export(root / "stages/frl_apartment_stage.glb", stage())
    for name in ("table", "box"):
        asset = f"frl_apartment_{name}_01"
        config = {"render_asset": f"../../objects/{asset}.glb", "scale": [1.0, 1.0, 1.0]}
        write(root / f"configs/objects/{asset}.object_config.json", config)
    export(root / "objects/frl_apartment_table_01.glb", [table_top(), *table_legs()])
    export(root / "objects/frl_apartment_bed_01.glb", [box((1.4, 0.5, 2.0), (0, 0.25, 0), (90, 90, 140))])
    export(root / "objects/frl_apartment_box_01.glb", [box((0.7, 0.9, 0.7), (0, 0.45, 0), (230, 230, 230))])
    return root


LAYOUTS = {"hssd": (write_hssd, "scenes/102344022"), "replicacad": (write_replicacad, "configs/scenes/apt_0")}


def load(root: Path) -> House:
    source = open_houses(f"habitat:{root}")
    (house_id,) = source.house_ids()
    house = source.load(house_id)
    check_house(house)
    assert source.examine(house_id) == house.findings  # type: ignore[attr-defined]
    return house


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_scene_becomes_a_house(layout: str, tmp_path: Path) -> None:
    make, house_id = LAYOUTS[layout]
    house = load(make(tmp_path))
    assert house.house_id == house_id
    left_out = {} if layout == "hssd" else {"articulated objects": 2}
    assert house.findings == {"missing meshes": 1, **left_out}
    types = {"hssd": ["Wall", "Table", "Bed", "Object"], "replicacad": ["Wall", "Table", "Bed", "Box"]}[
        layout
    ]
    assert [b.object_type for b in house.bodies] == types
    (room,) = house.rooms
    assert (np.ptp(room.polygon_m, axis=0) == pytest.approx((6, 5))) and room.room_type == "Bedroom"
    table = house.bodies[1]
    np.testing.assert_allclose(np.ptp(table.visual.vertices_m, axis=0), [0.8, 1.4, 0.74], atol=1e-4)
    assert covers(table, (3.0, -2.5), 0.72)
    assert not covers(table, (3.0, -2.5), 0.4)  # free between the legs
    heights = {s.object_type: s.height_m for s in house.surfaces}
    # A bed carries nothing; what is of no known type carries things on its flat top.
    expected = {"Table": 0.74, "Object": 0.9} if layout == "hssd" else {"Table": 0.74}
    assert heights == pytest.approx(expected, abs=1e-3)


def test_another_dataset_of_a_folder_is_named_by_its_file(tmp_path: Path) -> None:
    root = write_hssd(tmp_path)
    source = open_houses(f"habitat:{root}/hssd-hab-articulated.scene_dataset_config.json")
    assert source.house_ids() == ["scenes_articulated/102344022"]
    assert source.load(source.house_ids()[0]).findings["articulated objects"] == 1


def test_a_stage_stands_where_the_scene_places_it(tmp_path: Path) -> None:
    file = write_replicacad(tmp_path) / "configs/scenes/apt_0.scene_instance.json"
    scene = json.loads(file.read_text())
    scene["stage_instance"] |= {"translation": [-1.0, 0.0, 2.0], "rotation": [HALF, 0, HALF, 0]}
    write(file, scene)
    house = load(tmp_path)
    # 6 m along the file's x are turned to its -z, which is the world's y.
    np.testing.assert_allclose(house.rooms[0].polygon_m.min(0), (-1, -2), atol=1e-4)
    np.testing.assert_allclose(house.rooms[0].polygon_m.max(0), (4, 4), atol=1e-4)
    del scene["stage_instance"]["translation"]
    write(file, scene)
    turned = load(tmp_path).rooms[0].polygon_m
    np.testing.assert_allclose(turned, house.rooms[0].polygon_m + (1, 2), atol=1e-4)


@settings(max_examples=15)
@given(
    st.floats(-180, 180),
    st.tuples(st.floats(1.0, 5.0), st.floats(-0.2, 0.3), st.floats(1.0, 4.0)),
    st.tuples(*[st.floats(0.5, 1.5)] * 3),
    st.tuples(*[st.floats(0.5, 1.5)] * 3),
)
def test_any_pose_and_scale_places_the_mesh(
    tmp_path_factory: pytest.TempPathFactory,
    yaw: float,
    at: tuple[float, float, float],
    scale: tuple[float, float, float],
    stretch: tuple[float, float, float],
) -> None:
    root = write_replicacad(tmp_path_factory.mktemp("dataset"))
    half = np.deg2rad(yaw) / 2
    turn = (float(np.cos(half)), 0.0, float(np.sin(half)), 0.0)
    name = "frl_apartment_table_01"
    scene = json.loads((root / "configs/scenes/apt_0.scene_instance.json").read_text())
    scene["object_instances"] = [placed(f"objects/{name}", at, turn) | {"non_uniform_scale": list(stretch)}]
    write(root / "configs/scenes/apt_0.scene_instance.json", scene)
    config = {"render_asset": f"../../objects/{name}.glb", "scale": list(scale)}
    write(root / f"configs/objects/{name}.object_config.json", config)
    body = load(root).bodies[1]
    mesh = np.concatenate([m.vertices for m in [table_top(), *table_legs()]])
    expected = (mesh * scale * stretch @ rotation_of(np.array(turn)).T + at) @ Y_UP_TO_WORLD.T
    found = body.visual.vertices_m
    np.testing.assert_allclose(found.min(0), expected.min(0), atol=2e-4)
    np.testing.assert_allclose(found.max(0), expected.max(0), atol=2e-4)
    parts = np.concatenate(body.convex_parts_m)
    np.testing.assert_allclose(parts.max(0), expected.max(0), atol=5e-3)


@pytest.mark.parametrize(
    "stretch",
    [
        (0.7529410867130109, 0.9132418735931008, 1.2),
        (0.9994301199913064, 0.9985916020164893, 0.998558581047224),  # as many pieces of HSSD
        (2.0, 1.0, 0.5),
    ],
)
def test_a_stretched_table_carries_objects_on_its_stretched_top(
    tmp_path: Path, stretch: tuple[float, float, float]
) -> None:
    root = write_hssd(tmp_path)
    scene = json.loads((root / "scenes/102344022.scene_instance.json").read_text())
    turn = (np.cos(0.2), 0.0, np.sin(0.2), 0.0)
    scene["object_instances"] = [placed(TABLE, (3.0, 0.1, 2.5), turn) | {"non_uniform_scale": list(stretch)}]
    write(root / "scenes/102344022.scene_instance.json", scene)
    (surface,) = load(root).surfaces
    T, size_m = surface.T_world_surface, np.array(surface.size_m)
    np.testing.assert_allclose(size_m, (1.4 * stretch[0], 0.8 * stretch[2]), atol=0.042)  # cells of 2 cm
    np.testing.assert_allclose(T[:3, 3], (3.0, -2.5, 0.1 + 0.74 * stretch[1]), atol=0.022)
    c, s = np.cos(0.4), np.sin(0.4)
    np.testing.assert_allclose(T[:3, :3], [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=2e-3)


def test_a_mesh_of_two_sizes_is_of_its_own_size_whatever_was_loaded_before(tmp_path: Path) -> None:
    root = write_replicacad(tmp_path)
    scene = json.loads((root / "configs/scenes/apt_0.scene_instance.json").read_text())
    table, low = "frl_apartment_table_01", "frl_apartment_table_low"
    config = {"render_asset": f"../../objects/{table}.glb", "scale": [1.0, 0.6, 1.0]}
    write(root / f"configs/objects/{low}.object_config.json", config)
    scene["object_instances"] = [placed(f"objects/{low}", (2.5, 0.0, 3.0), (1.0, 0.0, 0.0, 0.0))]
    write(root / "configs/scenes/apt_1.scene_instance.json", scene)
    alone, after = open_houses(f"habitat:{root}"), open_houses(f"habitat:{root}")
    first, second = alone.house_ids()
    before = alone.load(second)
    after.load(first)
    assert after.load(second).digest == before.digest
    assert [s.height_m for s in before.surfaces] == pytest.approx([0.444], abs=1e-3)


def replace_glb(path: Path, **more: Any) -> None:
    """Add members to the description of a GLB file."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    text = json.dumps(json.loads(data[20 : 20 + length]) | more).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    size = (20 + len(text) + len(rest)).to_bytes(4, "little")
    path.write_bytes(data[:8] + size + len(text).to_bytes(4, "little") + data[16:20] + text + rest)


CONFIG = f"objects/a/{TABLE}.object_config.json"


@pytest.mark.parametrize(
    ("file", "value", "named"),
    [
        (
            CONFIG,
            {"render_asset": "../../../other.glb"},
            r"render_asset: '\.\./\.\./\.\./other\.glb' is not below",
        ),
        (
            CONFIG,
            {"render_asset": f"{TABLE}.glb", "up": [0, 0, 1]},
            r"\$\.up: is not 0, 1, 0\. Turn the mesh",
        ),
        (
            CONFIG,
            {"render_asset": f"{TABLE}.glb", "up": [0, 1, 0], "front": [0, 0, 1]},
            r"\$\.front: is not 0, 0, -1\. Turn the mesh",
        ),
        (CONFIG, {"render_asset": f"{TABLE}.glb", "scale": [1, 0, 1]}, r"\$\.scale\[1\]: 0 is not within"),
        (CONFIG, {"render_asset": f"{TABLE}.glb", "scale": [1, 1]}, r"\$\.scale: has 2 numbers"),
        (
            "scenes/102344022.scene_instance.json",
            {"stage_instance": {"template_name": "none"}},
            "has no stage 'none'",
        ),
        (
            "semantics/hssd-hab_semantic_lexicon.json",
            {"classes": [{"id": "x"}]},
            r"classes\[0\]\.id: is a string",
        ),
        ("hssd-hab.scene_dataset_config.json", {}, r"\$: has no key 'scene_instances'"),
        (
            "hssd-hab.scene_dataset_config.json",
            {"scene_instances": {"paths": {".json": ["../.."]}}},
            r"'\.\./\.\.' is not a path below",
        ),
        (
            "hssd-hab.scene_dataset_config.json",
            {"scene_instances": {"paths": {".json": ["none"]}}},
            "names no folder with scenes",
        ),
    ],
)
def test_bad_files_are_named(tmp_path: Path, file: str, value: Any, named: str) -> None:
    root = write_hssd(tmp_path)
    write(root / file, value)
    with pytest.raises(InputError, match=named) as caught:
        load(root)
    assert Path(file).name in str(caught.value)


def test_a_check_finds_a_missing_stage(tmp_path: Path) -> None:
    root = write_hssd(tmp_path)
    (root / "stages/102344022.glb").unlink()
    source = open_houses(f"habitat:{root}")
    with pytest.raises(InputError, match="has no stage 'stages/102344022'"):
        source.examine(source.house_ids()[0])  # type: ignore[attr-defined]


def test_compressed_meshes_are_refused_with_what_to_do(tmp_path: Path) -> None:
    root = write_hssd(tmp_path)
    replace_glb(root / "stages/102344022.glb", extensionsRequired=["EXT_meshopt_compression"])
    with pytest.raises(
        InputError, match=r"102344022\.glb: extensionsRequired: is compressed .*uncompressed meshes"
    ):
        load(root)


def test_labels_are_made_in_a_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_hssd(tmp_path / "hssd")
    words = ["--n", "60", "--candidates-per-scene", "30", "--workers", "0", "--out", str(tmp_path / "run")]
    assert cli.run(["submit", "heuristic", "--houses", f"habitat:{root}", *words]) == 0
    assert cli.run(["assets", "check", str(root)]) == 0
    assert "1 read; in the others missing meshes 1" in capsys.readouterr().out
    assert cli.run(["submit", "heuristic", "--houses", f"habitat:{tmp_path}", *words[:-1], "x"]) == 2
    assert "*.scene_dataset_config.json" in capsys.readouterr().err
