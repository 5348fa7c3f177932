"""A small instance of the habitat layout: a stage with two rooms, a table, a shelf and a mug."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House
from tests.workers.houses.house_checks import check_house, covers

HALF = float(np.sqrt(0.5))


def box(size: tuple[float, float, float], centre: tuple[float, float, float], rgb: tuple[int, int, int]):
    """A coloured box in the files' frame (y up)."""
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation(centre)
    mesh.visual.face_colors = np.tile([*rgb, 255], (len(mesh.faces), 1))
    return mesh


def floor(x0: float, x1: float, z1: float, rgb: tuple[int, int, int], y: float = 0.0):
    """A rectangle that looks up, from z = 0 on."""
    vertices = [[x0, y, 0], [x0, y, z1], [x1, y, z1], [x1, y, 0]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual.face_colors = np.tile([*rgb, 255], (2, 1))
    return mesh


def textured_box(size: tuple[float, float, float], rgb: tuple[int, int, int]):
    mesh = trimesh.creation.box(extents=size)
    image = Image.new("RGB", (8, 8), rgb)
    uv = np.full((len(mesh.vertices), 2), 0.5)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return mesh


def instance(name: str, at: tuple[float, float, float], rotation: tuple = (1, 0, 0, 0), **more: Any) -> dict:
    return {"template_name": f"objects/{name}", "translation": list(at), "rotation": list(rotation), **more}


def floor_at(height: float) -> trimesh.Trimesh:
    return floor(0, 4, 3, (200, 200, 200), y=height)


def export(path: Path, meshes: list[trimesh.Trimesh]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(trimesh.Scene(meshes).export(file_type="glb"))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two rooms, 4 x 3 m each, beside each other along the files' x; the wall between has a gap."""
    hab, plain = tmp_path / "ai2thor/ai2thor-hab", tmp_path / "ai2thor/ai2thorhab-uncompressed"
    stage = [
        floor(0, 4, 3, (150, 110, 70)),
        floor(4.1, 8, 3, (120, 120, 120)),
        box((8, 2.5, 0.1), (4, 1.25, -0.05), (230, 230, 220)),
        box((0.1, 2.5, 2.0), (4.05, 1.25, 2.0), (230, 230, 220)),
        box((8, 0.1, 3), (4, 2.6, 1.5), (255, 255, 255)),
    ]
    export(hab / "assets/stages/iTHOR/home.glb", stage)
    export(hab / "assets/stages/ProcTHOR/turned.glb", stage)
    legs = [box((0.06, 0.7, 0.06), (x, -0.02, z), (90, 60, 40)) for x in (-0.65, 0.65) for z in (-0.35, 0.35)]
    top = box((1.4, 0.04, 0.8), (0, 0.35, 0), (160, 120, 80))
    export(plain / "assets/objects/Dining_Table_9.glb", [top, *legs])
    export(plain / "assets/objects/Bed_1.glb", [box((1.4, 0.5, 2.0), (0, 0, 0), (90, 90, 140))])
    export(plain / "assets/objects/Mug_1.glb", [textured_box((0.1, 0.1, 0.1), (200, 30, 40))])
    types = {"DiningTable": 3, "Bed": 4, "Mug": 5}
    (hab / "configs").mkdir(parents=True)
    (hab / "configs/object_semantic_id_mapping.json").write_text(json.dumps(types))
    for name, number in (("Dining_Table_9", 3), ("Bed_1", 4), ("Mug_1", 5)):
        config = plain / f"configs/objects/{name}.object_config.json"
        config.parent.mkdir(parents=True, exist_ok=True)
        config.write_text(json.dumps({"semantic_id": number}))
    places = (
        ("Dining_Table_9", [2.0, 0.37, 1.2], [HALF, 0, HALF, 0]),
        ("Bed_1", [6.5, 0.25, 1.2], [1, 0, 0, 0]),
        ("Mug_1", [2.1, 0.79, 1.2], [1, 0, 0, 0]),
        ("Missing_1", [1, 0, 1], [1, 0, 0, 0]),
    )
    things = [
        {"template_name": f"objects/{name}", "translation": at, "rotation": turn} for name, at, turn in places
    ]
    for folder, stage_name in (("iTHOR", "stages/iTHOR/home"), ("ProcTHOR/1", "stages/ProcTHOR/turned")):
        scene = {"stage_instance": {"template_name": stage_name}, "object_instances": things}
        path = hab / f"configs/scenes/{folder}/home.scene_instance.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(scene))
    return tmp_path


def scene_file(root: Path) -> Path:
    return root / "ai2thor/ai2thor-hab/configs/scenes/iTHOR/home.scene_instance.json"


def load(root: Path) -> House:
    return open_houses(f"ai2thor:{root}").load("iTHOR/home")


def test_a_scene_becomes_a_house(root: Path):
    house = load(root)
    check_house(house)
    assert [b.object_type for b in house.bodies] == ["Wall", "DiningTable", "Bed", "Mug"]
    assert [b.kind for b in house.bodies] == ["wall", "furniture", "furniture", "small"]
    # (x, y, z) of the files is (x, -z, y) of the world.
    table = house.bodies[1].visual.vertices_m
    np.testing.assert_allclose((table.min(0) + table.max(0))[:2] / 2, [2.0, -1.2], atol=1e-5)
    np.testing.assert_allclose(np.ptp(table, axis=0)[:2], [0.8, 1.4], atol=1e-5)  # turned by 90 degrees
    assert table[:, 2].min() == pytest.approx(0, abs=1e-4)
    mug = house.bodies[3].visual.face_rgb.astype(int)
    assert (np.abs(mug - [200, 30, 40]) <= 6).all()  # the colour of its texture


def test_rooms_come_from_patches_of_floor_and_are_named_by_what_is_in_them(root: Path):
    house = load(root)
    rooms = sorted(house.rooms, key=lambda r: r.polygon_m[:, 0].min())
    np.testing.assert_allclose(rooms[0].polygon_m.min(0), [0, -3], atol=1e-5)
    np.testing.assert_allclose(rooms[0].polygon_m.max(0), [4, 0], atol=1e-5)
    assert rooms[1].room_type == "Bedroom"
    owners = {b.object_type: b.room_id for b in house.bodies}
    assert owners["DiningTable"] == owners["Mug"] == rooms[0].room_id
    assert owners["Bed"] == rooms[1].room_id


def test_tables_are_surfaces_with_legs_below_and_beds_are_not(root: Path):
    house = load(root)
    assert len(house.surfaces) == 1
    surface = house.surfaces[0]
    assert surface.height_m == pytest.approx(0.74, abs=1e-3)
    assert surface.size_m == pytest.approx((1.4, 0.8), abs=0.05)
    np.testing.assert_allclose(surface.T_world_surface[:2, 3], [2.0, -1.2], atol=0.02)
    table = house.bodies[1]
    assert covers(table, (2.0, -1.2), 0.72)
    assert not covers(table, (2.0, -1.2), 0.4)


def test_walls_have_gaps_and_the_ceiling_is_gone(root: Path):
    stage = load(root).bodies[0]
    assert any(covers_part(p, (4.0, -2.0, 1.0)) for p in stage.convex_parts_m)
    assert not any(covers_part(p, (4.0, -0.5, 1.0)) for p in stage.convex_parts_m)
    z = stage.visual.vertices_m[stage.visual.faces][:, :, 2]
    assert not ((np.ptp(z, axis=1) < 1e-3) & (z.min(1) > 2.4)).any()


def covers_part(part: np.ndarray, point: tuple[float, float, float]) -> bool:
    low, high = part.min(0) - 0.03, part.max(0) + 0.03
    return bool((low <= point).all() and (point <= high).all()) and np.ptp(part[:, 0]) < 0.05


def test_stages_of_the_procthor_set_are_turned_back(root: Path):
    source = open_houses(f"ai2thor:{root}")
    assert source.house_ids() == ["ProcTHOR/1/home", "iTHOR/home"]
    stage = source.load("ProcTHOR/1/home").bodies[0].visual.vertices_m
    plain = source.load("iTHOR/home").bodies[0].visual.vertices_m
    # A quarter turn about the vertical: (x, y) of one is (y, -x) or (-y, x) of the other.
    np.testing.assert_allclose(np.ptp(stage, axis=0)[[1, 0, 2]], np.ptp(plain, axis=0), atol=1e-4)
    np.testing.assert_allclose(
        sorted(map(tuple, np.round(stage, 3))),
        sorted(map(tuple, np.round(plain[:, [1, 0, 2]] * [1, -1, 1], 3))),
    )


def test_the_digests_follow_the_files(root: Path):
    before, house = open_houses(f"ai2thor:{root}").digest, load(root).digest
    assert open_houses(f"ai2thor:{root / 'ai2thor'}").digest == before
    mug = root / "ai2thor/ai2thorhab-uncompressed/assets/objects/Mug_1.glb"
    export(mug, [box((0.1, 0.1, 0.2), (0, 0, 0), (9, 9, 9))])
    assert open_houses(f"ai2thor:{root}").digest != before
    assert load(root).digest != house


def test_the_digests_follow_the_types_that_decide_what_carries_things(root: Path):
    before, house = open_houses(f"ai2thor:{root}").digest, load(root)
    mapping = root / "ai2thor/ai2thor-hab/configs/object_semantic_id_mapping.json"
    mapping.write_text(json.dumps({"DiningTable": 4, "Bed": 3, "Mug": 5}))
    changed = load(root)
    assert house.surfaces[0].body_id != changed.surfaces[0].body_id  # the bed became a table
    assert open_houses(f"ai2thor:{root}").digest != before
    assert changed.digest != house.digest


STAGE = "stages/iTHOR/home"


@pytest.mark.parametrize(
    ("stage", "objects", "named"),
    [
        (None, [], "has no key 'stage_instance'"),
        (STAGE, None, "has no key 'object_instances'"),
        ("../../../etc/passwd", [], "not a path below"),
        ("/etc/passwd", [], "not a path below"),
        ("stages/none", [], "has no stage 'stages/none'"),
        (STAGE, {}, "an object, not a list"),
    ],
)
def test_broken_scenes_are_named(root: Path, stage: str | None, objects: Any, named: str):
    scene = {"stage_instance": stage and {"template_name": stage}, "object_instances": objects}
    scene_file(root).write_text(json.dumps({k: v for k, v in scene.items() if v is not None}))
    with pytest.raises(InputError, match=named):
        load(root)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"translation": [1, 2]}, "has 2 numbers, not 3"),
        ({"translation": [1, float("nan"), 3]}, r"translation\[1\]: nan"),
        ({"rotation": [0, 0, 0, 0]}, "not a unit quaternion"),
        ({"uniform_scale": 0}, "uniform_scale: 0"),
        ({"non_uniform_scale": [1, 2]}, "non_uniform_scale: has 2 numbers, not 3"),
        ({"template_name": "objects/../../secret"}, "not a path below"),
    ],
)
def test_broken_instances_are_named(root: Path, change: dict, named: str):
    scene = json.loads(scene_file(root).read_text())
    scene["object_instances"][2] |= change
    scene_file(root).write_text(json.dumps(scene))
    with pytest.raises(InputError, match=named) as caught:
        load(root)
    assert "home.scene_instance.json" in str(caught.value) and "object_instances[2]" in str(caught.value)


def damaged(data: bytes, case: str) -> bytes:
    if case == "counts":
        start, length = 20, int.from_bytes(data[12:16], "little")
        text = json.loads(data[start : start + length])
        text["accessors"][0]["count"] = 10**12
        new = json.dumps(text).encode()
        return data[:12] + len(new).to_bytes(4, "little") + data[16:20] + new + data[start + length :]
    return {
        "empty": b"", "text": b"hello " * 20, "half": data[: len(data) // 2], "header only": data[:20],
        "noise": data[:20] + bytes(255 - b for b in data[20:]),
    }[case]  # fmt: skip


@pytest.mark.parametrize("case", ["empty", "text", "half", "header only", "noise", "counts"])
def test_damaged_meshes_are_named(root: Path, case: str):
    path = root / "ai2thor/ai2thorhab-uncompressed/assets/objects/Mug_1.glb"
    path.write_bytes(damaged(path.read_bytes(), case))
    with pytest.raises(InputError, match=r"Mug_1\.glb"):
        load(root)


def test_meshes_beyond_the_limits_are_refused(root: Path, monkeypatch: pytest.MonkeyPatch):
    from datagen.workers.houses import glb

    monkeypatch.setattr(glb, "MAX_FACES", 11)
    with pytest.raises(InputError, match="triangles, more than 11"):
        load(root)
    monkeypatch.setattr(glb, "MAX_FILE_BYTES", 100)
    with pytest.raises(InputError, match="more than the 100 allowed"):
        load(root)


def test_a_stage_that_is_only_a_ceiling_is_refused(root: Path):
    ceiling = floor(0, 4, 3, (200, 200, 200), y=2.5)
    export(root / "ai2thor/ai2thor-hab/assets/stages/iTHOR/home.glb", [ceiling])
    with pytest.raises(InputError, match="has neither walls nor floor"):
        load(root)


def test_folders_without_scenes(tmp_path: Path):
    with pytest.raises(InputError, match="ai2thor-hab/configs/scenes"):
        open_houses(f"ai2thor:{tmp_path}")
    (tmp_path / "ai2thor-hab/configs/scenes").mkdir(parents=True)
    with pytest.raises(InputError, match="no scenes"):
        open_houses(f"ai2thor:{tmp_path}")
    with pytest.raises(InputError):
        open_houses("ai2thor:")


def edit(root: Path, **more: object) -> dict:
    """The scene of `root` with other members."""
    scene = json.loads(scene_file(root).read_text()) | more
    scene_file(root).write_text(json.dumps(scene))
    return scene


@pytest.mark.parametrize("where", ["scene", "instance", "configured"])
def test_translations_of_the_centre_of_mass_place_it(root: Path, where: str):
    plain = root / "ai2thor/ai2thorhab-uncompressed"
    export(plain / "assets/objects/Bed_1.glb", [box((1.4, 0.5, 2.0), (0.1, 0.25, 0), (90, 90, 140))])
    things = [
        instance("Bed_1", (2.0, 0.74, 1.2), (HALF, 0, HALF, 0), non_uniform_scale=[1, 2, 1]),
        instance("Mug_1", (2.0, 1.0, 1.2)),
    ]
    if where == "instance":
        things[0]["translation_origin"] = "com"
        edit(root, object_instances=things, translation_origin="asset_local")
    else:
        edit(root, object_instances=things, translation_origin="COM")
    lifted_m = 0.24  # the centre is half a metre above the base at twice its height
    if where == "configured":
        config = plain / "configs/objects/Bed_1.object_config.json"
        config.write_text(json.dumps({"semantic_id": 4, "COM": [0.1, 0.3, 0.0]}))
        lifted_m = 0.14
    vertices = load(root).bodies[1].visual.vertices_m
    np.testing.assert_allclose(
        [vertices[:, 2].min(), vertices[:, 2].max()], [lifted_m, lifted_m + 1], atol=1e-5
    )
    np.testing.assert_allclose((vertices.min(0) + vertices.max(0))[:2] / 2, [2.0, -1.2], atol=1e-5)


def test_an_unknown_origin_of_translations_is_named(root: Path):
    edit(root, translation_origin="corner")
    with pytest.raises(InputError, match=r"\$\.translation_origin: unknown origin 'corner'.*asset_local"):
        load(root)


@pytest.mark.parametrize("height_m", [-0.3, 0.2])
def test_a_stage_whose_floor_is_not_at_zero_is_refused(root: Path, height_m: float):
    stage = [box((8, 2.5, 0.1), (4, 1.25, -0.05), (230, 230, 220)), floor_at(height_m)]
    export(root / "ai2thor/ai2thor-hab/assets/stages/iTHOR/home.glb", stage)
    with pytest.raises(InputError, match=rf"stage_instance: another floor: .* {height_m:g} m"):
        load(root)


def test_meshes_in_millimetres_are_refused_unless_the_scene_scales_them(root: Path):
    mug = root / "ai2thor/ai2thorhab-uncompressed/assets/objects/Mug_1.glb"
    bed = mug.with_name("Bed_1.glb")
    export(mug, [box((100, 100, 100), (0, 0, 0), (9, 9, 9))])
    export(bed, [box((1400, 500, 2000), (0, 0, 0), (9, 9, 9))])
    for number, span in ((2, "100"), (1, "2000")):
        with pytest.raises(InputError, match=rf"wrong unit: the object spans {span} m"):
            edit(
                root, object_instances=[json.loads(scene_file(root).read_text())["object_instances"][number]]
            )
            load(root)
        edit(root, object_instances=[instance("Mug_1", (2, 1, 1)), instance("Bed_1", (6, 1, 1))])
    scaled = [
        instance("Mug_1", (2, 1, 1), uniform_scale=1e-3),
        instance("Bed_1", (6, 1, 1), uniform_scale=1e-3),
    ]
    edit(root, object_instances=scaled)
    np.testing.assert_allclose(
        np.ptp(load(root).bodies[2].visual.vertices_m, axis=0), [1.4, 2.0, 0.5], rtol=1e-4
    )


def test_a_stage_in_millimetres_is_refused(root: Path):
    stage = [floor(0, 8000, 3000, (1, 2, 3)), box((8000, 2500, 100), (4000, 1250, -50), (230, 230, 220))]
    export(root / "ai2thor/ai2thor-hab/assets/stages/iTHOR/home.glb", stage)
    with pytest.raises(InputError, match="wrong unit: the stage spans 8000 m"):
        load(root)


def test_rotations_of_another_order_are_refused(root: Path):
    things = edit(root)["object_instances"]
    for thing in things:
        w, x, y, z = thing["rotation"]
        thing["rotation"] = [x, y, z, w]
    edit(root, object_instances=things)
    with pytest.raises(InputError, match=r"implausible: 3 of 3 objects stand upside down.*w, x, y, z"):
        load(root)


def test_missing_meshes_and_fallen_things_are_counted_without_meshes(root: Path):
    things = edit(root)["object_instances"]
    things[2]["rotation"] = [0, 1, 0, 0]
    edit(root, object_instances=things)
    source = open_houses(f"ai2thor:{root}")
    assert source.load("iTHOR/home").findings == {"missing meshes": 1, "implausible (upside down)": 1}
    assert source.examine("iTHOR/home") == source.load("iTHOR/home").findings  # type: ignore[attr-defined]
